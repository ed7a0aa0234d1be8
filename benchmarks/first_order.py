"""Fits of first-order lags to step responses."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar


class Step(NamedTuple):
    """One step response, rad/s or m/s^2, and its fit."""

    axis: str
    start: float
    target: float
    tau: float  # s
    error: float  # RMS, as a fraction of the step
    saturated: float  # fraction of the time with a motor command at a limit


def fit_step(axis, target, time, response, saturated=0.0) -> Step:
    """Least-squares fit of ``start + (target - start) (1 - exp(-t / tau))`` to a response (n,)."""
    start = float(response[0])

    def square(tau: float) -> float:
        return float(np.mean((response - target - (start - target) * np.exp(-time / tau)) ** 2))

    tau = float(minimize_scalar(square, bounds=(1e-3, 1.0), method="bounded").x)
    error = float(np.sqrt(square(tau))) / max(abs(target - start), 1e-9)
    return Step(axis, start, target, tau, error, saturated)
