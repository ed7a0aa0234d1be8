"""Checks against the simulator: own flights, observation, gates, estimator, closed loop."""

from collections.abc import Callable

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export import battery_emulator, flights, race_emulator
from quadjax.export.battery_tables import update_error
from quadjax.export.convert import POLICY_FILE
from quadjax.export.race_source import check_race
from quadjax.export.report import float64_commands
from quadjax.export.verify import measurements
from quadjax.export.verify.context import Context
from quadjax.export.verify.result import Failed, Skipped, require

OBSERVATION_TOLERANCE = 1e-6  # of each input's range
COMMAND_TOLERANCE = 1e-4  # of the range of a command
ESTIMATOR_TOLERANCE = (1e-6, 2e-5)  # moment, N m, and force, m/s^2
BATTERY_TOLERANCE = 0.01  # rpm
LAP_TOLERANCE = 1e-3  # s


def check_own_race(c: Context) -> str:
    """The race in the C code is the one in the policy file."""
    folder = c.folder
    allowed = c.allow_other_race and folder.options.allow_other_race
    path = folder.path / POLICY_FILE
    return _unless(
        allowed,
        lambda: check_race(folder.policy, folder.own, path),
        "allow_other_race=True",
    )


def check_own_flights(c: Context) -> str:
    """The policy finishes its own race: the flights of the conversion, repeated."""
    laps, own = flights.simulate(c.folder.own).laps, c.folder.own
    allowed = c.allow_unfinished and c.folder.options.allow_unfinished
    return _unless(
        allowed, lambda: flights.check_finished(laps, own, c.folder.name), "allow_unfinished=True"
    )


def _unless(allowed: bool, check: Callable[[], str], option: str) -> str:
    """The result of a check; a failed one that an option allows is skipped."""
    try:
        return check()
    except InputError as error:
        if allowed:
            raise Skipped(f"{error}; allowed by {option}") from None
        raise Failed(str(error)) from None


def check_observation(c: Context) -> str:
    """The C's observation of simulated states, and its commands, against the environment's."""
    folder, network, seen = c.folder, c.folder.network, c.folder.rollouts
    rows = c.flying.observe(seen.states, seen.targets)
    require(not np.any(rows[:, network.inputs :]), "a simulated state was clipped")
    same = race_emulator.observe(folder.race, seen.states, seen.targets)
    require(bool(np.all(rows[:, : network.inputs] == same.q)), "C and NumPy differ")
    shown = flights.observe_float64(folder.own, seen.states, seen.targets)
    found = rows[:, : network.inputs] / 2.0**30 * network.box.ranges
    error = np.abs(found - shown) / network.box.ranges
    # A yaw within rounding of half a turn is the same angle on either side.
    if "attitude" in network.box.layout:
        turn = network.box.layout.slice("attitude").start + 2
        error[:, turn] = np.minimum(
            error[:, turn], np.abs(error[:, turn] - 2.0 * np.pi / network.box.ranges[turn])
        )
    worst = float(error.max())
    require(worst <= OBSERVATION_TOLERANCE, f"{worst:.2g} of an input's range")
    exact = float64_commands(folder.policy, found)
    trained = float64_commands(folder.policy, shown)
    span = folder.policy.command_high - folder.policy.command_low
    change = float(np.median(np.max(np.abs(exact - trained) / span, axis=1)))
    require(change <= COMMAND_TOLERANCE, f"commands change by {change:.2g} of their range, median")
    return f"{len(rows)} simulated states: within {worst:.1e} of each input's range"


def check_gates(c: Context) -> str:
    """The C passes and misses the same gates as the simulator, at the same steps."""
    folder = c.folder
    followed = flights.paths(c.trace)
    followed.append(flights.wander(folder.own, steps=5000))
    counts = {race_emulator.PASSED: 0, race_emulator.MISSED: 0}
    for positions, targets in followed:
        rows = c.flying.events(positions, int(targets[0]))
        # The simulator's target at a step is the one after the step's own crossing.
        wrong = np.flatnonzero(rows[:, 1] != targets)
        require(not wrong.size, f"another target at step {wrong[0] if wrong.size else 0}")
        for event in counts:
            counts[event] += int(np.sum(rows[:, 0] == event))
    require(min(counts.values()) > 0, "no gate was passed, or none missed")
    passed, missed = counts.values()
    return f"{passed} gates passed and {missed} missed at the same steps as in the simulator"


def check_estimator(c: Context) -> str:
    """The C's estimator against ``quadjax.vehicle.estimator`` in float64.

    The measurements are those of simulated flights and of a drone that tumbles, both clipped to the
    ranges that the header states.
    """
    tables, vehicle = c.folder.estimator, c.folder.own.params.vehicle
    if tables is None:
        raise Skipped("the vehicle has no external disturbances")
    rate, cutoff, rng = tables.sample_rate, tables.cutoff, np.random.default_rng(0)
    logs = measurements.simulated(rng, vehicle, c.trace, c.folder.own.time_step, rate)
    logs = np.concatenate([logs, measurements.tumbling(rng, rate, logs.shape[1] / rate)[None]])
    limits = np.ldexp(np.float32(1.0), np.array(tables.exponents))
    logs = np.clip(logs, -limits, limits).astype(np.float32)
    found = np.stack([c.library.estimate(log) for log in logs]).astype(np.float64)
    moment, force = _worst(found - measurements.estimate_float64(vehicle, logs, rate, cutoff))
    require(moment <= ESTIMATOR_TOLERANCE[0], f"moment off by {moment:.2g} N m")
    require(force <= ESTIMATOR_TOLERANCE[1], f"force off by {force:.2g} m/s^2")
    return (
        f"{len(logs) * logs.shape[1]} samples, simulated and tumbling: within {moment:.1e} N m and "
        f"{force:.1e} m/s^2 of float64"
    )


def check_battery(c: Context) -> str:
    """The C's estimate of the highest speed against NumPy, and against float64.

    Samples of simulated flights, and of full power and less in turn as the battery empties.
    """
    tables, own = c.folder.battery, c.folder.own
    if tables is None:
        raise Skipped("the policy does not observe the highest rpm")
    rate, rng = tables.sample_rate, np.random.default_rng(0)
    logs = measurements.speeds_and_commands(rng, c.trace, own.time_step, rate)
    seconds, constants = logs.shape[1] / rate, own.params.vehicle.constants
    bursts = measurements.full_power_bursts(rng, constants, rate, seconds)
    logs = np.concatenate([logs, bursts[None]])
    found = np.stack([c.library.highest_rpm(log) for log in logs])
    require(np.array_equal(found, battery_emulator.run(tables, logs)), "C and NumPy differ")
    first = tables.first * tables.unit
    exact = measurements.highest_float64(constants, first, logs, rate)
    worst, moved = float(np.abs(found - exact).max()), float(np.ptp(found))
    require(worst <= BATTERY_TOLERANCE, f"off by {worst:.2g} rpm")
    return (
        f"{logs.shape[0] * logs.shape[1]} samples, simulated and full power: the bits of NumPy, "
        f"within {worst:.1e} rpm of float64 over {moved:.0f} rpm; proven for one sample: "
        f"{update_error(tables):.1e} rpm"
    )


def _worst(difference: np.ndarray) -> np.ndarray:
    """Largest error of moments and of forces, (2,), of differences (runs, n, 6)."""
    return np.array([np.abs(part).max() for part in np.split(difference, 2, axis=2)])


def check_closed_loop(c: Context) -> str:
    """The fixed-point policy finishes where the float policy does, in the same times."""
    folder, runs = c.folder, c.runs
    if not runs:
        raise Skipped("run it with --runs 200")
    single, fixed = flights.fly_float_and_fixed(
        folder.own, folder.policy, folder.network.box.declared, runs
    )
    require(single.crashes == fixed.crashes, "other finishes")
    both = np.isfinite(single.totals)
    if not both.any():
        return f"{runs} flights, none finished by either"
    apart = float(np.max(np.abs(single.totals[both] - fixed.totals[both])))
    require(apart <= LAP_TOLERANCE, f"times {apart * 1000:.1f} ms apart")
    mean = float(fixed.totals[both].mean())
    return (
        f"{runs} flights: {fixed.finished} finished by both, mean {mean:.3f} s, "
        f"at most {apart * 1000:.1f} ms apart"
    )
