"""The motors of a racing quadcopter from its logs: motor map and time constant.

``w = w_min + (w_max - w_min) sqrt(k U^2 + (1 - k) U)`` is the steady speed of a command U, which a
first-order lag ``tau`` follows. With measured speeds, the simulated ones are compared with them.
Without, the forces and moments of the simulated speeds are compared with the measured ones; the
scale of the speeds then has no effect, and ``w_max`` is that of the base vehicle.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.lag import LONGEST, SHORTEST, UNIT, Followed, blocks_of, followed
from quadjax.fitting.nominal import EQUATIONS, ModelInputs, regressors
from quadjax.fitting.prepare import SETTLING
from quadjax.fitting.regression import Estimate, Search, half_seconds, solve, unknown
from quadjax.fitting.signals import derivative, first_order, low_pass
from quadjax.vehicle.racing import RacingConstants

RPM = 30.0 / math.pi  # of 1 rad/s
NAMES = ("w_min", "w_max", "k", "tau")
EXPLAINED = 0.9  # R^2 below which there is a warning
LEAST_CHANGE = 0.01  # of the commands
THRUST_AND_MOMENTS = ("az", "Mx", "My", "Mz")
LEAST_RATE = 60.0  # Hz, of the samples compared without measured speeds


def steady_speeds(values: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Steady speeds, rad/s, of commands in [0, 1], both (n, 4); values as ``NAMES``."""
    low, high, k, _ = values
    u = np.clip(command, 0.0, 1.0)
    return low + (high - low) * np.sqrt(k * u * u + (1.0 - k) * u)


def with_simulated_speeds(log: FlightLog, values: np.ndarray) -> FlightLog:
    """A log with the speeds that its motor commands give; unchanged where they are measured.

    The speeds at its start are not known: the time until they have no effect counts as not flying.
    """
    if log.speeds_measured:
        return log
    steady = RPM * steady_speeds(values, log.motor_command)
    rpm = first_order(steady, steady[0], values[3], 1.0 / log.sample_rate)
    return replace(log, rpm=rpm, flying=settled(log))


def settled(log: FlightLog) -> np.ndarray:
    """Samples (n,) bool in flight at which the unknown speeds of the start have no effect."""
    return log.flying & (log.time - log.time[0] > SETTLING)


def fit_motors(
    logs: Sequence[FlightLog], rows: Sequence[np.ndarray], base: RacingConstants, cutoff: float
) -> Estimate:
    """Fit the constants of the motors, in the order of ``NAMES``.

    Args:
        logs: flights; those with motor commands are used.
        rows: of each, (n,) bool.
        base: values without evidence in the logs.
        cutoff: of the low-pass of forces and moments, Hz.
    """
    start = np.array([float(getattr(base, name)) for name in NAMES])
    pairs = zip(logs, rows, strict=True)
    parts = [(log, used) for log, used in pairs if log.motor_command is not None and used.any()]
    kept = dict(zip(NAMES, start, strict=True))
    if not parts:
        return unknown("motors", kept, "the logs have no motor commands")
    if max(float(np.ptp(log.motor_command[used])) for log, used in parts) < LEAST_CHANGE:
        return unknown("motors", kept, "the motor commands never change")
    measured = [
        followed(log, used, log.rpm / RPM, log.motor_command)
        for log, used in parts
        if log.speeds_measured
    ]
    flights = [_Unmeasured(log, used, base, cutoff) for log, used in parts if not measured]
    found = solve(_with_speeds(measured, start) if measured else _without(flights, start))
    if found.r_squared >= EXPLAINED:
        return found
    line = (
        f"motors: the commands explain the motors by an R^2 of {found.r_squared:.2f}: is "
        "logs.motor_range right?"
    )
    return replace(found, warnings=(*found.warnings, line))


def _with_speeds(parts: list[Followed], start: np.ndarray) -> Search:
    measured = np.concatenate([part.measured for part in parts])
    high = max(float(measured.max()), start[1])

    def model(values: np.ndarray) -> np.ndarray:
        tau = values[3]
        steady = ((part, steady_speeds(values, part.command)) for part in parts)
        return np.concatenate([part.simulated(tau, speeds) for part, speeds in steady])

    return Search(
        group="motors",
        names=NAMES,
        base=start,
        measured=measured,
        blocks=blocks_of(parts),
        uncertain=EQUATIONS[RacingConstants].uncertain,
        model=model,
        low=np.array([0.0, 0.1 * high, 0.0, SHORTEST]),
        high=np.array([0.9 * high, 10.0 * high, 1.0, LONGEST]),
        unit=np.array([1000.0, 1000.0, 1.0, UNIT]),
        physical=("w_min", "k"),
    )


@dataclass(frozen=True)
class _Unmeasured:
    """Some rows of a flight without measured speeds."""

    log: FlightLog
    used: np.ndarray  # (n,) bool
    base: RacingConstants
    cutoff: float

    @property
    def rows(self) -> np.ndarray:
        """Indices of the samples that are compared."""
        return np.flatnonzero(self.used)[:: max(1, int(self.log.sample_rate / LEAST_RATE))]

    def measured(self) -> np.ndarray:
        """Filtered force and angular accelerations (m, 4), as ``THRUST_AND_MOMENTS``."""
        rate = self.log.sample_rate
        turn = derivative(low_pass(self.log.rates, rate, self.cutoff), rate)
        force = low_pass(self.log.specific_force[:, 2:], rate, self.cutoff)
        return np.concatenate([force, turn], axis=1)[self.rows]

    def regressors(self, values: np.ndarray) -> dict[str, np.ndarray]:
        """Filtered regressors (m, k) by axis of the speeds that the commands give."""
        log = with_simulated_speeds(self.log, values)
        rate = log.sample_rate
        motion = ModelInputs(log.rpm, derivative(log.rpm, rate), log.body_velocity, log.rates)
        columns = regressors(motion, self.base)
        return {
            axis: low_pass(columns[axis], rate, self.cutoff)[self.rows]
            for axis in THRUST_AND_MOMENTS
        }


def _without(flights: list[_Unmeasured], start: np.ndarray) -> Search:
    measured = np.concatenate([flight.measured() for flight in flights])
    measured = measured / measured.std(axis=0)

    def model(values: np.ndarray) -> np.ndarray:
        """Forces and moments with the best constants of the rotors for these motors."""
        parts = [flight.regressors(values) for flight in flights]
        modeled = np.empty_like(measured)
        for axis, name in enumerate(THRUST_AND_MOMENTS):
            columns = np.concatenate([part[name] for part in parts])
            columns = columns / np.sqrt((columns**2).mean(axis=0))
            solution = np.linalg.lstsq(columns, measured[:, axis], rcond=1e-10)[0]
            modeled[:, axis] = columns @ solution
        return modeled

    times = [flight.log.time[flight.rows] - flight.log.time[0] for flight in flights]
    index = np.repeat(np.arange(len(times)), [len(time) for time in times])
    return Search(
        group="motors",
        names=NAMES,
        base=start,
        measured=measured,
        blocks=half_seconds(np.concatenate(times), index),
        uncertain=EQUATIONS[RacingConstants].uncertain,
        model=model,
        low=np.array([0.0, 0.0, 0.0, SHORTEST]),
        high=np.array([0.5 * start[1], np.inf, 1.0, LONGEST]),
        unit=np.array([1000.0, 1000.0, 1.0, UNIT]),
        physical=("w_min", "k"),
        fixed=("w_max",),
    )
