"""The motors of a racing quadcopter from its logs: motor map and time constant.

``w = w_min + (w_max - w_min) sqrt(k U^2 + (1 - k) U)`` is the steady speed of a command U, which a
first-order lag ``tau`` follows. With measured speeds, the simulated ones are compared with them.
Without, the forces and moments of the simulated speeds are compared with the measured ones; the
scale of the speeds then has no effect, and ``w_max`` is that of the base vehicle.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from quadjax.fitting.config import PrepareConfig
from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.lag import LONGEST, SHORTEST, Followed, followed
from quadjax.fitting.least_squares import BLOCK
from quadjax.fitting.nominal import EQUATIONS, ModelInputs, regressors
from quadjax.fitting.prepare import airborne
from quadjax.fitting.signals import derivative, first_order, low_pass
from quadjax.vehicle.racing import RacingConstants

RPM = 30.0 / math.pi  # of 1 rad/s
NAMES = ("w_min", "w_max", "k", "tau")
SETTLING = 0.5  # s
MOST_STEPS = 40  # of the solver
EXPLAINED = 0.9  # R^2 below which there is a warning
LEAST_CHANGE = 0.01  # of the commands
THRUST_AND_MOMENTS = ("az", "Mx", "My", "Mz")
LEAST_RATE = 60.0  # Hz, of the samples compared without measured speeds
Errors = Callable[[np.ndarray], np.ndarray]  # (m,) parameters -> (n,) errors


@dataclass(frozen=True)
class MotorFit:
    """Constants of the motors, in the order of ``NAMES``."""

    values: np.ndarray  # (4,) rad/s, rad/s, 1, s
    standard_errors: np.ndarray  # (4,), infinite where not fitted
    r_squared: float  # of the speeds, or of the forces and moments
    warnings: tuple[str, ...]

    @property
    def constants(self) -> dict[str, float]:
        """The values by name."""
        return dict(zip(NAMES, map(float, self.values), strict=True))


def steady_speeds(values: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Steady speeds, rad/s, of commands in [0, 1], both (n, 4); values as ``NAMES``."""
    low, high, k, _ = values
    u = np.clip(command, 0.0, 1.0)
    return low + (high - low) * np.sqrt(k * u * u + (1.0 - k) * u)


def fit_motors(logs: Sequence[FlightLog], base: RacingConstants, config: PrepareConfig) -> MotorFit:
    """Fit the constants of the motors.

    Args:
        logs: flights; those with motor commands are used.
        base: values without information in the logs.
        config: of filtering and trimming.
    """
    start = np.array([float(getattr(base, name)) for name in NAMES])
    parts = [(log, airborne(log, config)) for log in logs if log.motor_command is not None]
    if not parts:
        return _unknown(start, "the logs have no motor commands")
    if max(float(np.ptp(log.motor_command[rows])) for log, rows in parts) < LEAST_CHANGE:
        return _unknown(start, "the motor commands never change")
    measured = [
        followed(log, rows, log.rpm / RPM, log.motor_command)
        for log, rows in parts
        if log.speeds_measured
    ]
    if measured:
        return _fit_measured(measured, start)
    flights = [_Unmeasured(log, base, config, i) for i, (log, _) in enumerate(parts)]
    return _fit_unmeasured(flights, start)


def _unknown(start: np.ndarray, reason: str) -> MotorFit:
    kept = ", ".join(f"{name} {value:.4g}" for name, value in zip(NAMES, start, strict=True))
    line = f"motors: {reason}; the base vehicle's {kept} are kept"
    return MotorFit(start, np.full(4, np.inf), 0.0, (line,))


def _fit_measured(parts: list[Followed], start: np.ndarray) -> MotorFit:
    def errors(values: np.ndarray) -> np.ndarray:
        return np.concatenate([_speed_errors(part, values) for part in parts])

    speeds = np.concatenate([part.measured for part in parts])
    rows = np.concatenate(
        [np.arange(len(part.measured)) // max(1, int(BLOCK * part.rate)) for part in parts]
    )
    flights = np.repeat(np.arange(len(parts)), [len(part.measured) for part in parts])
    blocks = np.unique(flights * 1_000_000 + rows, return_inverse=True)[1]
    free = np.ones(4, bool)
    high = max(float(speeds.max()), start[1])
    bounds = (np.array([0.0, 0.1 * high, 0.0, SHORTEST]), [0.9 * high, 10 * high, 1.0, LONGEST])
    return _solved(errors, start, free, bounds, np.repeat(blocks, 4), speeds, ())


def _speed_errors(part: Followed, values: np.ndarray) -> np.ndarray:
    """Measured minus simulated speeds (n * 4,), rad/s."""
    steady = steady_speeds(values, part.command)
    pieces = zip(
        np.split(part.measured, part.starts[1:]), np.split(steady, part.starts[1:]), strict=True
    )
    simulated = [first_order(u, own[0], values[3], 1.0 / part.rate) for own, u in pieces]
    return (part.measured - np.concatenate(simulated)).ravel()


def with_simulated_speeds(log: FlightLog, values: np.ndarray) -> FlightLog:
    """A log with the speeds that its motor commands give; unchanged where they are measured.

    The speeds at its start are not known: the time until they have no effect counts as not flying.
    """
    if log.speeds_measured:
        return log
    steady = RPM * steady_speeds(values, log.motor_command)
    rpm = first_order(steady, steady[0], values[3], 1.0 / log.sample_rate)
    return dataclasses.replace(log, rpm=rpm, flying=settled(log))


def settled(log: FlightLog) -> np.ndarray:
    """Samples (n,) bool in flight at which the unknown speeds of the start have no effect."""
    return log.flying & (log.time - log.time[0] > SETTLING)


class _Unmeasured:
    """A flight without measured speeds: what its forces and moments are, and would be."""

    def __init__(
        self, log: FlightLog, base: RacingConstants, config: PrepareConfig, index: int
    ) -> None:
        self.log, self.base, self.cutoff = log, base, config.cutoff
        rows = np.flatnonzero(airborne(log, config) & (log.time - log.time[0] > SETTLING))
        self.rows = rows[:: max(1, int(log.sample_rate / LEAST_RATE))]
        turn = derivative(low_pass(log.rates, log.sample_rate, self.cutoff), log.sample_rate)
        force = low_pass(log.specific_force[:, 2:], log.sample_rate, self.cutoff)
        self.measured = np.concatenate([force, turn], axis=1)[self.rows]
        self.block = np.floor(log.time[self.rows] / BLOCK) + 1e6 * index

    def regressors(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Filtered regressors (n, k) by axis of the speeds that the commands give."""
        log = with_simulated_speeds(self.log, values)
        rate = log.sample_rate
        motion = ModelInputs(log.rpm, derivative(log.rpm, rate), log.body_velocity, log.rates)
        columns = regressors(motion, self.base)
        return {
            axis: low_pass(columns[axis], rate, self.cutoff)[self.rows]
            for axis in THRUST_AND_MOMENTS
        }


def _fit_unmeasured(flights: list[_Unmeasured], start: np.ndarray) -> MotorFit:
    measured = np.concatenate([flight.measured for flight in flights])
    measured = measured / measured.std(axis=0)

    def errors(values: np.ndarray) -> np.ndarray:
        found = [flight.regressors(values) for flight in flights]
        left = np.empty_like(measured)
        for axis, name in enumerate(THRUST_AND_MOMENTS):
            columns = np.concatenate([each[name] for each in found])
            columns = columns / np.sqrt((columns**2).mean(axis=0))
            solution = np.linalg.lstsq(columns, measured[:, axis], rcond=1e-10)[0]
            left[:, axis] = measured[:, axis] - columns @ solution
        return left.ravel()

    blocks = np.concatenate([flight.block for flight in flights])
    blocks = np.repeat(np.unique(blocks, return_inverse=True)[1], len(THRUST_AND_MOMENTS))
    free = np.array([True, False, True, True])
    bounds = (np.array([0.0, 0.0, 0.0, SHORTEST]), [0.5 * start[1], np.inf, 1.0, LONGEST])
    line = (
        "w_max: not determined, because the logs have no rotor speeds; the base vehicle's "
        f"{start[1]:.4g} rad/s is kept, and all constants of the rotors are relative to it"
    )
    return _solved(errors, start, free, bounds, blocks, measured, (line,))


def _solved(
    errors: Errors,
    start: np.ndarray,
    free: np.ndarray,
    bounds: tuple[np.ndarray, Sequence[float]],
    blocks: np.ndarray,
    signal: np.ndarray,
    lines: tuple[str, ...],
) -> MotorFit:
    """Nonlinear least squares for the free values, with cluster-robust standard errors."""
    low, high = (np.asarray(bound, float)[free] for bound in bounds)
    size = np.array([1000.0, 1000.0, 1.0, 0.05])[free]

    def full(scaled: np.ndarray) -> np.ndarray:
        values = start.copy()
        values[free] = scaled * size
        return values

    first = np.clip(start[free], low + 1e-6 * size, high - 1e-6 * size) / size
    found = least_squares(
        lambda scaled: errors(full(scaled)),
        first,
        bounds=(low / size, high / size),
        diff_step=1e-4,
        xtol=1e-9,
        ftol=1e-10,
        max_nfev=MOST_STEPS,
    )
    jacobian, error = found.jac, found.fun
    scores = np.zeros((int(blocks.max()) + 1, len(size)))
    np.add.at(scores, blocks, jacobian * error[:, None])
    bread = np.linalg.pinv(jacobian.T @ jacobian)
    covariance = bread @ (scores.T @ scores) @ bread
    spread = float(((signal - signal.mean(axis=0)) ** 2).sum())
    values, deviations = full(found.x), np.full(4, np.inf)
    deviations[free] = np.sqrt(np.diag(covariance)) * size
    uncertain = [
        f"{name}: little excited by the logs: {value:.4g} +- {deviation:.2g}"
        for name, value, deviation in zip(NAMES, values, deviations, strict=True)
        if np.isfinite(deviation) and deviation > EQUATIONS[RacingConstants].uncertain * abs(value)
    ]
    if not found.success:
        uncertain.append(
            f"motors: the solver stopped after {MOST_STEPS} steps, before it converged"
        )
    r_squared = 1.0 - float((error**2).sum()) / max(spread, 1e-300)
    if r_squared < EXPLAINED:
        uncertain.append(
            f"motors: the commands explain the motors by an R^2 of {r_squared:.2f}: is "
            "logs.motor_range right?"
        )
    return MotorFit(values, deviations, r_squared, (*lines, *uncertain))
