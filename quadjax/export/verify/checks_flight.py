"""Checks against the Python that trains: observation, gate logic, estimator, closed loop."""

import numpy as np

from quadjax.export import flights, race_emulator
from quadjax.export.report import float64_commands
from quadjax.export.verify.context import Context
from quadjax.export.verify.result import LeftOut, require
from quadjax.fit.estimator_reference import estimate

OBSERVATION_TOLERANCE = 1e-6  # of each input's range
COMMAND_TOLERANCE = {"motor": 0.5, "rate": 1e-4}  # rpm; of the range
MOMENT_TOLERANCE, FORCE_TOLERANCE = 1e-6, 2e-5  # N m, m/s^2
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
    flown = flights.fly_traced(folder.own, folder.policy, runs=4, laps=3)
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


def _measurements(rng: np.random.Generator, rate: float, seconds: float) -> np.ndarray:
    """A drone that is thrown about, with noise: (n, 13) float32."""
    t = np.arange(round(rate * seconds)) / rate
    gyro = [8.0 * np.sin(2 * np.pi * f * t + f) for f in (1.3, 2.1, 0.7)]
    force = [5.0 * np.sin(3 * t), 4.0 * np.cos(2 * t), -9.8 + 6.0 * np.sin(7 * t)]
    rpm = [7500.0 + 2500.0 * np.sin(9 * t + i) for i in range(4)]
    velocity = [6.0 * np.sin(t), 3.0 * np.sin(2 * t), 2.0 * np.cos(t)]
    clean = np.stack([*gyro, *force, *rpm, *velocity], axis=1)
    noise = np.array([0.1] * 3 + [0.5] * 3 + [20.0] * 4 + [0.02] * 3)
    return (clean + noise * rng.standard_normal(clean.shape)).astype(np.float32)


def check_estimator(c: Context) -> str:
    """The C's estimator beside the float64 reference, over eight seconds of hard flight."""
    tables = c.folder.estimator
    if tables is None:
        raise LeftOut("a rate-level policy does not see the disturbances")
    measured = _measurements(np.random.default_rng(0), tables.sample_rate, 8.0)
    found = c.library.estimate(measured).astype(np.float64)
    exact = measured.astype(np.float64)
    signals = {
        "gyro": exact[:, 0:3],
        "specific_force": exact[:, 3:6],
        "rpm": exact[:, 6:10],
        "body_velocity": exact[:, 10:13],
    }
    vehicle = c.folder.own.params.vehicle
    moment, force = estimate(vehicle, signals, tables.sample_rate, tables.cutoff)
    errors = (np.abs(found[:, :3] - moment).max(), np.abs(found[:, 3:] - force).max())
    require(errors[0] <= MOMENT_TOLERANCE, f"moment off by {errors[0]:.2g} N m")
    require(errors[1] <= FORCE_TOLERANCE, f"force off by {errors[1]:.2g} m/s^2")
    return (
        f"{len(measured)} samples: within {errors[0]:.1e} N m and {errors[1]:.1e} m/s^2 of float64"
    )


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
