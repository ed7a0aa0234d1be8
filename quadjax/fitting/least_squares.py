"""Least squares for the constants of the nominal model, with honest standard errors.

Neighbouring samples of a filtered signal are nearly the same sample, so the textbook's standard
errors, which take every row for an independent one, come out many times too small. Here rows are
grouped into blocks of half a second, and the errors follow from how much the blocks disagree
(the cluster-robust covariance of Liang and Zeger, 1986).

Noise in a regressor adds to the diagonal of the normal equations and so pulls its constant towards
zero; what it adds is estimated in ``prepare`` and subtracted (bias-compensated least squares).
"""

from dataclasses import dataclass

import numpy as np

from quadjax.fitting.nominal import AXES, CONSTANTS
from quadjax.fitting.prepare import Samples
from quadjax.vehicle.constants import MotorConstants

BLOCK = 0.5  # s
HARDLY = 0.05  # a relative standard error above this earns a warning
CONDITION = 1e6  # regressors worse conditioned than this (scaled to unit size) are collinear


@dataclass(frozen=True)
class AxisFit:
    """The constants of one axis."""

    axis: str
    names: tuple[str, ...]
    values: np.ndarray  # (k,)
    standard_errors: np.ndarray  # (k,), infinite where the log says nothing
    condition: float  # of the regressors, each scaled to unit size
    r_squared: float
    rmse: float
    warnings: tuple[str, ...]


def fit_nominal(samples: Samples, base: MotorConstants) -> list[AxisFit]:
    """Fit every axis of the nominal model.

    Args:
        samples: see ``prepare``.
        base: constants that the log says nothing of keep these values.
    """
    blocks = _blocks(samples)
    return [fit_axis(axis, samples, blocks, base) for axis in AXES]


def with_fit(base: MotorConstants, fits: list[AxisFit]) -> MotorConstants:
    """The base vehicle's constants with those of the fit in their place."""
    found = {
        name: float(value)
        for fit in fits
        for name, value in zip(fit.names, fit.values, strict=True)
    }
    return base.replace(**found)


def fit_axis(axis: str, samples: Samples, blocks: np.ndarray, base: MotorConstants) -> AxisFit:
    """Least squares for one axis; see ``fit_nominal``."""
    names = CONSTANTS[axis]
    columns, target = samples.regressors[axis], samples.measured[:, AXES.index(axis)]
    kept = np.array([float(getattr(base, name)) for name in names])
    size = np.sqrt((columns**2).mean(axis=0))
    told = _told_apart(columns, size)
    values, errors = kept.copy(), np.full(len(names), np.inf)
    condition = np.inf
    if told.any():
        scaled = columns[:, told] / size[told]
        remainder = target - columns[:, ~told] @ kept[~told]
        noise = samples.disturbed[axis][:, told] / size[told]
        solution, covariance, condition = _solve(scaled, noise, remainder, blocks)
        values[told] = solution / size[told]
        errors[told] = np.sqrt(np.diag(covariance)) / size[told]
    error = target - columns @ values
    spread = ((target - target.mean()) ** 2).sum()
    return AxisFit(
        axis=axis,
        names=names,
        values=values,
        standard_errors=errors,
        condition=float(condition if told.all() else np.inf),
        r_squared=float(1.0 - (error**2).sum() / spread) if spread > 0.0 else 0.0,
        rmse=float(np.sqrt((error**2).mean())),
        warnings=_warnings(axis, names, values, errors, told),
    )


def r_squared(measured: np.ndarray, modelled: np.ndarray) -> np.ndarray:
    """``1 - sum(error^2) / sum((measured - mean)^2)`` of each column."""
    spread = ((measured - measured.mean(axis=0)) ** 2).sum(axis=0)
    return 1.0 - ((measured - modelled) ** 2).sum(axis=0) / np.maximum(spread, 1e-300)


def _blocks(samples: Samples) -> np.ndarray:
    """A number (n,) for each block of half a second of one flight."""
    label = samples.flight * 1_000_000 + np.floor(samples.time / BLOCK).astype(int)
    return np.unique(label, return_inverse=True)[1]


def _told_apart(columns: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Which columns are neither zero nor a combination of the ones before them."""
    told = np.zeros(columns.shape[1], bool)
    for index in range(columns.shape[1]):
        if size[index] <= 1e-12:
            continue
        trial = told.copy()
        trial[index] = True
        told[index] = np.linalg.cond(columns[:, trial] / size[trial]) < CONDITION
    return told


def _solve(
    columns: np.ndarray, noise: np.ndarray, target: np.ndarray, blocks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Solution, its cluster-robust covariance, and the condition number."""
    gram, extra = columns.T @ columns, noise.T @ noise
    # Noise that rivals the signal is no small correction any more: take off a tenth at most.
    extra *= min(1.0, 0.1 / max(float((np.diag(extra) / np.diag(gram)).max()), 1e-12))
    bread = np.linalg.inv(gram - extra)
    solution = bread @ (columns.T @ target)
    error = target - columns @ solution
    count = int(blocks.max()) + 1
    scores = np.zeros((count, columns.shape[1]))
    np.add.at(scores, blocks, columns * error[:, None])
    scores -= scores.mean(axis=0)  # what was taken off gives them a mean
    freedom = count / max(1, count - columns.shape[1])
    covariance = freedom * bread @ (scores.T @ scores) @ bread
    return solution, covariance, float(np.linalg.cond(columns))


def _warnings(
    axis: str,
    names: tuple[str, ...],
    values: np.ndarray,
    errors: np.ndarray,
    told: np.ndarray,
) -> tuple[str, ...]:
    lines = []
    for name, value, error, excited in zip(names, values, errors, told, strict=True):
        if not excited:
            lines.append(
                f"{name} ({axis}): the logs do not excite it; the base vehicle's {value:.4g} is "
                "kept"
            )
        elif error > HARDLY * abs(value):
            lines.append(
                f"{name} ({axis}): the logs hardly excite it, or the nominal model does not fit "
                f"them: +- {100.0 * error / max(abs(value), 1e-300):.0f}%"
            )
    return tuple(lines)
