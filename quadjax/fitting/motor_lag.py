"""Time constant of the motors, from commanded and measured propeller speeds.

The model ``omega' = (u - omega) / tau`` is simulated from the commands and compared with the
measurement, so noise in the measured speed does not bias the result, as it does when the derivative
is regressed on ``u - omega``.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.least_squares import BLOCK, UNCERTAIN
from quadjax.fitting.signals import first_order

SHORTEST, LONGEST = 0.002, 0.5  # s
LEAST_CHANGE = 20.0  # rpm, of the commands


@dataclass(frozen=True)
class LagFit:
    """The time constant of the motors."""

    tau: float  # s
    standard_error: float  # s, infinite where not excited
    r_squared: float  # of the simulated speeds
    warning: str | None


def fit_motor_lag(logs: list[FlightLog], flying: list[np.ndarray], base_tau: float) -> LagFit:
    """Fit the time constant over every flight that has commands.

    Args:
        logs: the flights.
        flying: rows of each in flight, (n,) bool.
        base_tau: value without information in the logs, s.
    """
    usable = [
        (log.rpm[rows], log.rpm_command[rows], log.sample_rate, _starts(rows))
        for log, rows in zip(logs, flying, strict=True)
        if log.rpm_command is not None
    ]
    if not usable:
        return _unknown(base_tau, "the logs have no commanded propeller speeds")
    if all(np.ptp(command, axis=0).max() < LEAST_CHANGE for _, command, _, _ in usable):
        return _unknown(base_tau, "the commanded propeller speeds never change")

    def errors(tau: float) -> np.ndarray:
        return np.concatenate([rpm - _follow(tau, rpm, u, f, s) for rpm, u, f, s in usable])

    tau, at_the_edge = _minimize(lambda t: float((errors(t) ** 2).sum()))
    error = errors(tau)
    step = 1e-3 * tau
    slope = (errors(tau + step) - errors(tau - step)) / (2.0 * step)
    standard_error = _standard_error(error, slope, usable)
    measured = np.concatenate([rpm for rpm, _, _, _ in usable])
    spread = ((measured - measured.mean(axis=0)) ** 2).sum()
    warning = None
    if at_the_edge:
        warning = f"tau: the best value, {tau:.3g} s, is at the edge of the search range"
    elif standard_error > UNCERTAIN * tau:
        warning = f"tau: little excited by the logs: {tau:.3g} +- {standard_error:.2g} s"
    return LagFit(tau, standard_error, float(1.0 - (error**2).sum() / spread), warning)


def _minimize(cost: Callable[[float], float]) -> tuple[float, bool]:
    """The time constant of least cost, and whether it is at the edge of the search range."""
    grid = np.geomspace(SHORTEST, LONGEST, 25)
    best = int(np.argmin([cost(tau) for tau in grid]))
    bounds = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    found = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-6})
    return float(found.x), best in (0, len(grid) - 1)


def _unknown(base_tau: float, reason: str) -> LagFit:
    return LagFit(
        base_tau, np.inf, 0.0, f"tau: {reason}; the base vehicle's {base_tau:g} s is kept"
    )


def _starts(rows: np.ndarray) -> np.ndarray:
    """Indices, among the rows in flight, at which a contiguous part begins."""
    index = np.flatnonzero(rows)
    return np.flatnonzero(np.concatenate([[True], np.diff(index) > 1]))


def _follow(
    tau: float, rpm: np.ndarray, command: np.ndarray, rate: float, starts: np.ndarray
) -> np.ndarray:
    """Simulated speeds (n, 4), each command held until the next sample."""
    parts = zip(np.split(rpm, starts[1:]), np.split(command, starts[1:]), strict=True)
    return np.concatenate([first_order(u, own[0], tau, 1.0 / rate) for own, u in parts])


def _standard_error(
    error: np.ndarray,
    slope: np.ndarray,
    usable: list[tuple[np.ndarray, np.ndarray, float, np.ndarray]],
) -> float:
    """Cluster-robust standard error of tau, from blocks of half a second."""
    scores, start = [], 0
    for rpm, _, rate, _ in usable:
        product = (error * slope)[start : start + len(rpm)].sum(axis=1)
        edges = np.arange(0, len(rpm), max(1, int(BLOCK * rate)))
        scores.append(np.add.reduceat(product, edges))
        start += len(rpm)
    blocks = np.concatenate(scores)
    return float(np.sqrt((blocks**2).sum()) / (slope**2).sum())
