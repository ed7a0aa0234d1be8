"""Time constants of first-order lags, from commanded and measured signals.

The model ``y' = (u - y) / tau`` is simulated from the commands and compared with the measurement,
so noise in the measured signal does not bias the result, as it does when the derivative is
regressed on ``u - y``. It is the lag of the motors (propeller speeds) and, for the rate-and-thrust
model, that of the inner loop (body rates, and specific thrust).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.least_squares import BLOCK, UNCERTAIN
from quadjax.fitting.signals import first_order

SHORTEST, LONGEST = 0.002, 0.5  # s


@dataclass(frozen=True)
class LagFit:
    """One time constant."""

    tau: float  # s
    standard_error: float  # s, infinite where not excited
    r_squared: float  # of the simulated signals
    warning: str | None


@dataclass(frozen=True)
class Followed:
    """Commands and the signals that follow them, in the airborne rows of one flight."""

    measured: np.ndarray  # (n, k)
    command: np.ndarray  # (n, k)
    rate: float  # Hz
    starts: np.ndarray  # rows at which a contiguous part begins


def followed(
    log: FlightLog, flying: np.ndarray, measured: np.ndarray, command: np.ndarray
) -> Followed:
    """The rows in flight (n,) bool of signals (n, k) and their commands."""
    index = np.flatnonzero(flying)
    starts = np.flatnonzero(np.concatenate([[True], np.diff(index) > 1]))
    return Followed(measured[flying], command[flying], log.sample_rate, starts)


def fit_motor_lag(logs: list[FlightLog], flying: list[np.ndarray], base_tau: float) -> LagFit:
    """Fit the motors' time constant over every flight that has commands.

    Args:
        logs: the flights.
        flying: rows of each in flight, (n,) bool.
        base_tau: value without information in the logs, s.
    """
    parts = [
        followed(log, rows, log.rpm, log.rpm_command)
        for log, rows in zip(logs, flying, strict=True)
        if log.rpm_command is not None
    ]
    return fit_lag(parts, base_tau, "tau", "propeller speeds", 20.0)


def fit_lag(
    parts: Sequence[Followed], base_tau: float, name: str, what: str, least_change: float
) -> LagFit:
    """Fit one time constant over several flights.

    Args:
        parts: of the flights that have commands.
        base_tau: value without information in the logs, s.
        name: of the constant.
        what: the signals, for messages.
        least_change: of the commands, in their unit.
    """
    if not parts:
        return _unknown(base_tau, name, f"the logs have no commanded {what}")
    if all(np.ptp(part.command, axis=0).max() < least_change for part in parts):
        return _unknown(base_tau, name, f"the commanded {what} never change")

    def errors(tau: float) -> np.ndarray:
        return np.concatenate([part.measured - _follow(tau, part) for part in parts])

    tau, at_the_edge = _minimize(lambda t: float((errors(t) ** 2).sum()))
    error = errors(tau)
    step = 1e-3 * tau
    slope = (errors(tau + step) - errors(tau - step)) / (2.0 * step)
    standard_error = _standard_error(error, slope, parts)
    measured = np.concatenate([part.measured for part in parts])
    spread = ((measured - measured.mean(axis=0)) ** 2).sum()
    warning = None
    if at_the_edge:
        warning = f"{name}: the best value, {tau:.3g} s, is at the edge of the search range"
    elif standard_error > UNCERTAIN * tau:
        warning = f"{name}: little excited by the logs: {tau:.3g} +- {standard_error:.2g} s"
    return LagFit(tau, standard_error, float(1.0 - (error**2).sum() / spread), warning)


def _minimize(cost: Callable[[float], float]) -> tuple[float, bool]:
    """The time constant of least cost, and whether it is at the edge of the search range."""
    grid = np.geomspace(SHORTEST, LONGEST, 25)
    best = int(np.argmin([cost(tau) for tau in grid]))
    bounds = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-6})
    return float(found.x), best in (0, len(grid) - 1)


def _unknown(base_tau: float, name: str, reason: str) -> LagFit:
    return LagFit(
        base_tau, np.inf, 0.0, f"{name}: {reason}; the base vehicle's {base_tau:g} s is kept"
    )


def _follow(tau: float, part: Followed) -> np.ndarray:
    """Simulated signals (n, k), each command held until the next sample."""
    pieces = zip(
        np.split(part.measured, part.starts[1:]),
        np.split(part.command, part.starts[1:]),
        strict=True,
    )
    return np.concatenate([first_order(u, own[0], tau, 1.0 / part.rate) for own, u in pieces])


def _standard_error(error: np.ndarray, slope: np.ndarray, parts: Sequence[Followed]) -> float:
    """Cluster-robust standard error of the time constant, from blocks of half a second."""
    scores, start = [], 0
    for part in parts:
        product = (error * slope)[start : start + len(part.measured)].sum(axis=1)
        edges = np.arange(0, len(product), max(1, int(BLOCK * part.rate)))
        scores.append(np.add.reduceat(product, edges))
        start += len(product)
    blocks = np.concatenate(scores)
    return float(np.sqrt((blocks**2).sum()) / (slope**2).sum())
