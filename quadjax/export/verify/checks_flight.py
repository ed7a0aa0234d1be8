"""Checks against the Python that trains: observation, gate logic, estimator, closed loop."""

import numpy as np

from quadjax.export import flights, race_emulator
from quadjax.export.report import float64_commands
from quadjax.export.verify import measurements
from quadjax.export.verify.context import Context
from quadjax.export.verify.result import LeftOut, require
from quadjax.fitting.estimator_reference import estimate

OBSERVATION_TOLERANCE = 1e-6  # of each input's range
COMMAND_TOLERANCE = {"motor": 0.5, "rate": 1e-4}  # rpm; of the range
# Moment, N m, and force, m/s^2: of the float64 reference, and of the float32 that trains.
ESTIMATOR_TOLERANCE, TRAINED_TOLERANCE = (1e-6, 2e-5), (1e-5, 2e-4)
LAP_TOLERANCE = 1e-3  # s


def check_observation(c: Context) -> str:
    """The C's observation of flown states, and what it commands, beside the environment's."""
    folder, network = c.folder, c.folder.network
    rows = c.library.observe(folder.states, folder.targets)
    require(not np.any(rows[:, network.inputs :]), "a flown state was clipped")
    same = race_emulator.observe(folder.race, folder.states, folder.targets)
    require(bool(np.all(rows[:, : network.inputs] == same.q)), "C and NumPy differ")
    shown = flights.observe(folder.own, folder.states, folder.targets).astype(np.float64)
    found = rows[:, : network.inputs] / 2.0**30 * network.box.ranges
    error = np.abs(found - shown) / network.box.ranges
    # A yaw within rounding of half a turn is the same angle on either side.
    turn = network.box.index("attitude") + 2
    error[:, turn] = np.minimum(
        error[:, turn], np.abs(error[:, turn] - 2.0 * np.pi / network.box.ranges[turn])
    )
    worst = float(error.max())
    require(worst <= OBSERVATION_TOLERANCE, f"{worst:.2g} of an input's range")
    exact = float64_commands(folder.policy, found)
    trained = float64_commands(folder.policy, shown)
    scale = 1.0
    if folder.policy.vehicle == "rate":
        scale = folder.policy.command_high - folder.policy.command_low
    change = float(np.median(np.max(np.abs(exact - trained) / scale, axis=1)))
    limit = COMMAND_TOLERANCE[folder.policy.vehicle]
    require(change <= limit, f"commands move by {change:.2g}, median")
    return f"{len(rows)} flown states: within {worst:.1e} of each input's range"


def check_gates(c: Context) -> str:
    """The C passes and misses the same gates at the same steps as the simulator's rules say."""
    folder = c.folder
    flown = flights.paths(c.trace)
    flown.append(flights.wander(folder.own, steps=5000))
    counts = {race_emulator.PASSED: 0, race_emulator.MISSED: 0}
    for positions, targets in flown:
        rows = c.library.events(positions, int(targets[0]))
        # The simulator's target at a step is the one after the step's own crossing.
        wrong = np.flatnonzero(rows[:, 1] != targets)
        require(not wrong.size, f"another target at step {wrong[0] if wrong.size else 0}")
        for event in counts:
            counts[event] += int(np.sum(rows[:, 0] == event))
    require(min(counts.values()) > 0, "no gate was passed, or none missed")
    passed, missed = counts.values()
    return f"{passed} gates passed and {missed} missed at the same steps as in the simulator"


def check_estimator(c: Context) -> str:
    """The C's estimator beside the float64 reference and beside the one that policies train with.

    Over what the sensors of flights say, and of a drone that is thrown about, both held to the
    ranges that the header states: beyond them the C clips and says so, as its vectors show.
    """
    tables, vehicle = c.folder.estimator, c.folder.own.params.vehicle
    if tables is None:
        raise LeftOut("a rate-level policy does not see the disturbances")
    rate, cutoff, rng = tables.sample_rate, tables.cutoff, np.random.default_rng(0)
    logs = measurements.flown(rng, vehicle, c.trace, c.folder.own.config.episode.dt, rate)
    logs = np.concatenate([logs, measurements.thrown(rng, rate, logs.shape[1] / rate)[None]])
    limits = np.ldexp(np.float32(1.0), np.array(tables.exponents))
    logs = np.clip(logs, -limits, limits).astype(np.float32)
    found = np.stack([c.library.estimate(log) for log in logs]).astype(np.float64)
    exact = [estimate(vehicle, measurements.signals(log), rate, cutoff) for log in logs]
    exact = _worst(found - np.stack([np.concatenate(pair, axis=1) for pair in exact]))
    trained = _worst(found - measurements.estimate_as_trained(vehicle, logs, rate, cutoff))
    for (moment, force), tolerance, who in (
        (exact, ESTIMATOR_TOLERANCE, "float64"),
        (trained, TRAINED_TOLERANCE, "the Python that trains"),
    ):
        require(moment <= tolerance[0], f"moment off by {moment:.2g} N m from {who}")
        require(force <= tolerance[1], f"force off by {force:.2g} m/s^2 from {who}")
    return (
        f"{len(logs) * logs.shape[1]} samples, flown and thrown: within {exact[0]:.1e} N m and "
        f"{exact[1]:.1e} m/s^2 of float64, {trained[0]:.1e} and {trained[1]:.1e} of the Python "
        "that trains"
    )


def _worst(difference: np.ndarray) -> np.ndarray:
    """Largest error of moments and of forces, (2,), of differences (runs, n, 6)."""
    return np.array([np.abs(part).max() for part in np.split(difference, 2, axis=2)])


def check_closed_loop(c: Context, runs: int) -> str:
    """The fixed-point policy flies the float policy's races: the same finishes and times."""
    if not runs:
        raise LeftOut("ask for it with --flights 200")
    folder = c.folder
    single, fixed = flights.fly_both(folder.own, folder.policy, folder.network, runs)
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
