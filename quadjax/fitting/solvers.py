"""Least squares in units of the parameters: linear with noise in its columns, and any other."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import least_squares

LARGEST_CORRECTION = 0.1  # of the signal, by the noise in a regressor
LEAST_LEFT = 0.1  # of the least excited combination of columns, without their noise


class Minimum(NamedTuple):
    """The solution of a problem for its f free parameters."""

    values: np.ndarray  # (f,) in units
    unit: np.ndarray  # (f,)
    jacobian: np.ndarray  # (n m, f) of what is modeled, by the values in units
    bread: np.ndarray  # (f, f) inverse of the normal equations, in units
    converged: bool = True  # false if the solver stopped at its limit of steps
    hidden: bool = False  # some combination of columns is little but noise, not subtracted


def linear(columns: np.ndarray, noise: np.ndarray, signal: np.ndarray) -> Minimum:
    """Least squares of a signal (n,) by columns (n, f), less the effect of their noise (n, f)."""
    size = np.sqrt((columns**2).mean(axis=0))
    columns, noise = columns / size, noise / size
    gram, extra = columns.T @ columns, noise.T @ noise
    largest = float((np.diag(extra) / np.diag(gram)).max())
    extra *= min(1.0, LARGEST_CORRECTION / max(largest, 1e-12))
    least, with_noise = (np.linalg.eigvalsh(normal)[0] for normal in (gram - extra, gram))
    hidden = bool(least < LEAST_LEFT * with_noise)
    bread = np.linalg.inv(gram if hidden else gram - extra)
    return Minimum(bread @ (columns.T @ signal), 1.0 / size, columns, bread, hidden=hidden)


def nonlinear(
    error: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
    unit: np.ndarray,
    max_steps: int,
) -> Minimum:
    """Least squares of errors (n m,) by values (f,) within limits; ``unit`` (f,) is their size."""
    low, high = limits[0] / unit, limits[1] / unit
    result = least_squares(
        lambda scaled: error(scaled * unit),
        np.clip(start / unit, low + 1e-6, high - 1e-6),
        bounds=(low, high),
        diff_step=1e-4,
        xtol=1e-9,
        ftol=1e-10,
        max_nfev=max_steps,
    )
    bread = np.linalg.pinv(result.jac.T @ result.jac)
    return Minimum(result.x, unit, result.jac, bread, bool(result.success))
