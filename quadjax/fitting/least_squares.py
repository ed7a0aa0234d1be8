"""Least squares for the constants of the nominal model, with cluster-robust standard errors.

Neighboring samples of a filtered signal are correlated, so standard errors that assume independent
rows are too small. Rows are grouped into blocks of half a second, whose scores give the covariance
(Liang and Zeger, 1986).

Noise in a regressor adds to the diagonal of the normal equations and biases its constant towards
zero; its contribution, estimated in ``prepare``, is subtracted (bias-compensated least squares).
"""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.nominal import AXES, EQUATIONS, Constants
from quadjax.fitting.prepare import Samples
from quadjax.vehicle.constants import replaced, values_of

BLOCK = 0.5  # s
UNCERTAIN = 0.05  # relative standard error above which a lag has a warning
LOW_R2 = 0.1  # below which an axis has a warning
SIGNIFICANT = 3.0  # standard errors
Fitted = TypeVar("Fitted", bound=Constants)
CONDITION = 1e6  # condition number (of regressors of unit size) above which they are collinear


@dataclass(frozen=True)
class AxisFit:
    """The constants of one axis."""

    axis: str
    names: tuple[str, ...]
    values: np.ndarray  # (k,)
    standard_errors: np.ndarray  # (k,), infinite where not excited
    condition: float  # of the regressors, each scaled to unit size
    r_squared: float
    rmse: float
    warnings: tuple[str, ...]
    driving: tuple[str, ...]  # constants that must be positive


def fit_nominal(samples: Samples, base: Constants, any_sign: bool = False) -> list[AxisFit]:
    """Fit every axis of the nominal model.

    Args:
        samples: see ``prepare``.
        base: values for constants that the logs do not excite, and for those with an estimate of an
            impossible sign that is small or within its uncertainty of zero.
        any_sign: accept constants of an impossible sign.
    """
    blocks = half_seconds(samples)
    return [fit_axis(axis, samples, blocks, base, any_sign) for axis in AXES]


def with_fit(base: Fitted, fits: list[AxisFit]) -> Fitted:
    """The base vehicle's constants with the fitted ones replaced."""
    found = {
        name: float(value)
        for fit in fits
        for name, value in zip(fit.names, fit.values, strict=True)
    }
    return replaced(base, found)


def fit_axis(
    axis: str, samples: Samples, blocks: np.ndarray, base: Constants, any_sign: bool = False
) -> AxisFit:
    """Least squares for one axis; see ``fit_nominal``."""
    equations = EQUATIONS[type(base)]
    names = equations.constants[axis]
    columns, target = samples.regressors[axis], samples.measured[:, AXES.index(axis)]
    kept = np.array([float(values_of(base)[name]) for name in names])
    size = np.sqrt((columns**2).mean(axis=0))
    excited = _excited(columns, size)
    small = np.array([name in equations.small for name in names])
    driving = np.array([name in equations.driving for name in names])
    lines: list[str] = []
    while True:
        values, errors, condition = kept.copy(), np.full(len(names), np.inf), np.inf
        if excited.any():
            scaled = columns[:, excited] / size[excited]
            remainder = target - columns[:, ~excited] @ kept[~excited]
            noise = samples.noise[axis][:, excited] / size[excited]
            solution, covariance, condition = _solve(scaled, noise, remainder, blocks)
            values[excited] = solution / size[excited]
            errors[excited] = np.sqrt(np.diag(covariance)) / size[excited]
        doubtful = small | (driving & (values > -SIGNIFICANT * errors))
        doubtful &= excited & (values < 0.0) & (not any_sign)
        if not doubtful.any():
            break
        excited &= ~doubtful
        lines += [
            f"{names[i]} ({axis}): {values[i]:.2g} +- {errors[i]:.1g} is impossible below 0"
            for i in np.flatnonzero(doubtful)
        ]
    error = target - columns @ values
    spread = ((target - target.mean()) ** 2).sum()
    r2 = float(1.0 - (error**2).sum() / spread) if spread > 0.0 else 0.0
    return AxisFit(
        axis=axis,
        names=names,
        values=values,
        standard_errors=errors,
        condition=float(condition if excited.all() else np.inf),
        r_squared=r2,
        rmse=float(np.sqrt((error**2).mean())),
        warnings=(
            *lines,
            *_warnings(axis, names, values, errors, excited, r2, equations.uncertain),
        ),
        driving=equations.driving,
    )


def check_signs(fits: list[AxisFit]) -> None:
    """Reject constants of an impossible sign.

    Raises:
        InputError: a constant that is significantly negative and cannot be.
    """
    wrong = [
        f"{name} = {value:.3g} +- {error:.2g} ({fit.axis})"
        for fit in fits
        for name, value, error in zip(fit.names, fit.values, fit.standard_errors, strict=True)
        if name in fit.driving and value < 0.0 and np.isfinite(error)
    ]
    if wrong:
        raise InputError(
            f"the fit has {', '.join(wrong)}, expected above 0: a column of that axis "
            "is negated or swapped; nominal.any_sign=true accepts it"
        )


def r_squared(measured: np.ndarray, modeled: np.ndarray) -> np.ndarray:
    """``1 - sum(error^2) / sum((measured - mean)^2)`` of each column."""
    spread = ((measured - measured.mean(axis=0)) ** 2).sum(axis=0)
    return 1.0 - ((measured - modeled) ** 2).sum(axis=0) / np.maximum(spread, 1e-300)


def half_seconds(samples: Samples) -> np.ndarray:
    """Index (n,) of the block of half a second of one flight."""
    label = samples.flight * 1_000_000 + np.floor(samples.time / BLOCK).astype(int)
    return np.unique(label, return_inverse=True)[1]


def _excited(columns: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Columns (k,) that are neither zero nor a combination of those before them."""
    found = np.zeros(columns.shape[1], bool)
    for index in range(columns.shape[1]):
        if size[index] <= 1e-12:
            continue
        trial = found.copy()
        trial[index] = True
        found[index] = np.linalg.cond(columns[:, trial] / size[trial]) < CONDITION
    return found


def _solve(
    columns: np.ndarray, noise: np.ndarray, target: np.ndarray, blocks: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Solution, its cluster-robust covariance, and the condition number."""
    gram, extra = columns.T @ columns, noise.T @ noise
    # The correction is for small noise: subtract at most a tenth of the signal.
    extra *= min(1.0, 0.1 / max(float((np.diag(extra) / np.diag(gram)).max()), 1e-12))
    bread = np.linalg.inv(gram - extra)
    solution = bread @ (columns.T @ target)
    error = target - columns @ solution
    count = int(blocks.max()) + 1
    scores = np.zeros((count, columns.shape[1]))
    np.add.at(scores, blocks, columns * error[:, None])
    scores -= scores.mean(axis=0)  # the correction shifts their mean
    freedom = count / max(1, count - columns.shape[1])
    covariance = freedom * bread @ (scores.T @ scores) @ bread
    return solution, covariance, float(np.linalg.cond(columns))


def _warnings(
    axis: str,
    names: tuple[str, ...],
    values: np.ndarray,
    errors: np.ndarray,
    excited: np.ndarray,
    r2: float,
    uncertain: float,
) -> tuple[str, ...]:
    lines = []
    if r2 < LOW_R2:
        lines.append(f"{axis}: R^2 is {r2:.2f}: the nominal model explains little of the logs")
    for name, value, error, known in zip(names, values, errors, excited, strict=True):
        if not known:
            lines.append(
                f"{name} ({axis}): not fitted to the logs, which do not determine it: {value:.4g}"
            )
        elif error > uncertain * abs(value):
            lines.append(
                f"{name} ({axis}): little excited by the logs, or the nominal model does not fit "
                f"them: +- {100.0 * error / max(abs(value), 1e-300):.0f}%"
            )
    return tuple(lines)
