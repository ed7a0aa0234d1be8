"""Least squares with cluster-robust standard errors, for every model that a fit has.

Neighboring samples of a filtered signal are correlated, so standard errors that assume independent
rows are too small. Rows are grouped into blocks of half a second of one flight, whose scores give
the covariance (Liang and Zeger, 1986).

A parameter without evidence keeps its value of the base vehicle, and the others are fitted again:
one that the logs do not determine (a column that is zero or a combination of others), one that
cannot be below zero and is not ``SIGNIFICANT`` standard errors above it, and one at a limit of the
search. All of a problem keep it that explain too little of the signal.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from quadjax.core.errors import InputError

BLOCK = 0.5  # s
SIGNIFICANT = 2.0  # standard errors above zero
NEGATED = 3.0  # standard errors below zero, from which on a column of the log must be wrong
CONDITION = 1e6  # condition number (of columns of unit size) above which they are collinear
LITTLE_EXPLAINED = 0.1  # R^2 below which there is a warning
LARGEST_CORRECTION = 0.1  # of the signal, by the noise in a regressor
AT_LIMIT = 0.01  # relative distance to a limit of the search
MAX_STEPS = 40  # of the solver


@dataclass(frozen=True)
class Estimate:
    """The fitted parameters of one problem.

    Attributes:
        group: that they belong to: an axis, or what they describe.
        names: of the k parameters.
        values: (k,).
        standard_errors: (k,), infinite where the base value is kept.
        condition: of the columns, each scaled to unit size; infinite with a kept base value.
        r_squared: of the signal, over all its columns.
        rmse: of the signal.
        warnings: one line each.
        negated: parameters that are significantly below zero and cannot be, as text.
        converged: false if the solver stopped at its limit of steps.
    """

    group: str
    names: tuple[str, ...]
    values: np.ndarray
    standard_errors: np.ndarray
    condition: float = np.inf
    r_squared: float = 0.0
    rmse: float = np.nan
    warnings: tuple[str, ...] = ()
    negated: tuple[str, ...] = ()
    converged: bool = True

    @property
    def constants(self) -> dict[str, float]:
        """The values by name."""
        return dict(zip(self.names, map(float, self.values), strict=True))

    @property
    def errors(self) -> dict[str, float]:
        """The standard errors by name."""
        return dict(zip(self.names, map(float, self.standard_errors), strict=True))


@dataclass(frozen=True)
class Minimum:
    """The solution for the free parameters of a problem, f of them, in units of ``size``."""

    values: np.ndarray  # (f,)
    size: np.ndarray  # (f,)
    jacobian: np.ndarray  # (n m, f) of what is modeled
    bread: np.ndarray  # (f, f) inverse of the normal equations
    converged: bool = True


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Parameters, and the signal that they have to explain.

    Attributes:
        group: that the parameters belong to: an axis, or what they describe.
        names: of the k parameters.
        base: (k,) their values without evidence.
        measured: (n,) or (n, m) signal.
        blocks: (n,) index of the half second of one flight; see ``half_seconds``.
        positive: names of those that cannot be below zero.
        small: names of those of them that may absorb what the model lacks, so that even a value
            significantly below zero does not mean that a column of the log is wrong.
        uncertain: relative standard error above which a parameter has a warning.
        least_explained: R^2 below which all parameters keep their base values.
    """

    group: str
    names: tuple[str, ...]
    base: np.ndarray
    measured: np.ndarray
    blocks: np.ndarray
    positive: Sequence[str] = ()
    small: Sequence[str] = ()
    uncertain: float = 0.05
    least_explained: float = -np.inf

    def modeled(self, values: np.ndarray) -> np.ndarray:
        """What parameters (k,) give, of the shape of the signal."""
        raise NotImplementedError

    def determined(self) -> np.ndarray:
        """Parameters (k,) bool that the signal can determine."""
        return np.ones(len(self.names), bool)

    def minimum(self, free: np.ndarray) -> Minimum:
        """The best values of the free parameters (k,) bool; the others have their base values."""
        raise NotImplementedError

    def at_limit(self, values: np.ndarray) -> np.ndarray:
        """Parameters (k,) bool at a limit of the search, beyond which they could be as well."""
        return np.zeros(len(values), bool)


@dataclass(frozen=True, kw_only=True)
class Linear(Problem):
    """A signal (n,) that is a sum of parameters times columns.

    Noise in a column adds to the diagonal of the normal equations and biases its parameter towards
    zero; that part is subtracted (bias-compensated least squares).

    Attributes:
        columns: (n, k).
        noise: (n, k) change of the columns by added noise; see ``prepare``.
    """

    columns: np.ndarray
    noise: np.ndarray

    def modeled(self, values: np.ndarray) -> np.ndarray:
        """The sum (n,)."""
        return self.columns @ values

    def determined(self) -> np.ndarray:
        """Columns that are neither zero nor a combination of those before them."""
        size = np.sqrt((self.columns**2).mean(axis=0))
        found = np.zeros(len(size), bool)
        for index in np.flatnonzero(size > 1e-12):
            trial = found.copy()
            trial[index] = True
            found[index] = np.linalg.cond(self.columns[:, trial] / size[trial]) < CONDITION
        return found

    def minimum(self, free: np.ndarray) -> Minimum:
        """The solution of the normal equations."""
        size = np.sqrt((self.columns[:, free] ** 2).mean(axis=0))
        columns, noise = self.columns[:, free] / size, self.noise[:, free] / size
        remainder = self.measured - self.columns[:, ~free] @ self.base[~free]
        gram, extra = columns.T @ columns, noise.T @ noise
        largest = float((np.diag(extra) / np.diag(gram)).max())
        extra *= min(1.0, LARGEST_CORRECTION / max(largest, 1e-12))
        bread = np.linalg.inv(gram - extra)
        return Minimum(bread @ (columns.T @ remainder), 1.0 / size, columns, bread)


@dataclass(frozen=True, kw_only=True)
class Search(Problem):
    """A nonlinear problem, solved from the base values within limits.

    Attributes:
        model: parameters (k,) -> what they give, of the shape of the signal.
        low: (k,) limits of the search.
        high: (k,)
        unit: (k,) sizes of the parameters.
        physical: names of parameters whose limits are properties of the model, not of the search.
        fixed: names of parameters that the signal does not determine.
    """

    model: Callable[[np.ndarray], np.ndarray]
    low: np.ndarray
    high: np.ndarray
    unit: np.ndarray
    physical: Sequence[str] = ()
    fixed: Sequence[str] = ()

    def determined(self) -> np.ndarray:
        """All but the fixed ones."""
        return np.array([name not in self.fixed for name in self.names])

    def modeled(self, values: np.ndarray) -> np.ndarray:
        """What the model gives."""
        return self.model(values)

    def minimum(self, free: np.ndarray) -> Minimum:
        """The solution of ``scipy.optimize.least_squares``."""
        unit = self.unit[free]
        low, high = self.low[free] / unit, self.high[free] / unit

        def error(scaled: np.ndarray) -> np.ndarray:
            values = self.base.copy()
            values[free] = scaled * unit
            return (self.modeled(values) - self.measured).ravel()

        found = least_squares(
            error,
            np.clip(self.base[free] / unit, low + 1e-6, high - 1e-6),
            bounds=(low, high),
            diff_step=1e-4,
            xtol=1e-9,
            ftol=1e-10,
            max_nfev=MAX_STEPS,
        )
        bread = np.linalg.pinv(found.jac.T @ found.jac)
        return Minimum(found.x, unit, found.jac, bread, bool(found.success))

    def at_limit(self, values: np.ndarray) -> np.ndarray:
        """Parameters within ``AT_LIMIT`` of their limits."""
        near = np.isclose(values, self.low, rtol=AT_LIMIT, atol=0.0)
        near |= np.isclose(values, self.high, rtol=AT_LIMIT, atol=0.0)
        return near & np.array([name not in self.physical for name in self.names])


def solve(problem: Problem) -> Estimate:
    """The parameters of a problem, with base values where the logs have no evidence."""
    free = problem.determined()
    lines = [
        _kept(problem, index, "the logs do not determine it") for index in np.flatnonzero(~free)
    ]
    while True:
        values, errors, found = problem.base.copy(), np.full(len(free), np.inf), None
        if free.any():
            found = problem.minimum(free)
            values[free] = found.values * found.size
            error = (problem.measured - problem.modeled(values)).ravel()
            errors[free] = _standard_errors(found, error, problem.blocks) * found.size
        doubtful = _without_evidence(problem, values, errors)
        if not doubtful:
            break
        lines += doubtful.values()
        free[list(doubtful)] = False
    explained, rmse = _quality(problem, values)
    if free.any() and explained < problem.least_explained:
        part = f"it explains {max(explained, 0.0):.0%} of the signal in the logs"
        lines += [_kept(problem, index, part) for index in np.flatnonzero(free)]
        values, errors = problem.base.copy(), np.full(len(free), np.inf)
    if explained < LITTLE_EXPLAINED:
        lines.append(f"{problem.group}: R^2 is {explained:.2f}: the model explains little")
    with np.errstate(invalid="ignore"):
        uncertain = np.isfinite(errors) & (errors > problem.uncertain * np.abs(values))
    lines += [
        f"{problem.names[i]} ({problem.group}): little excited by the logs, or the model does not "
        f"fit them: {values[i]:.4g} +- {_percent(errors[i], values[i])}"
        for i in np.flatnonzero(uncertain)
    ]
    converged = found is None or found.converged
    if not converged:
        steps = f"the solver stopped after {MAX_STEPS} steps, before it converged"
        lines.append(f"{problem.group}: {steps}")
    return Estimate(
        group=problem.group,
        names=problem.names,
        values=values,
        standard_errors=errors,
        condition=np.inf if found is None or not free.all() else _condition(found),
        r_squared=explained,
        rmse=rmse,
        warnings=tuple(lines),
        negated=tuple(
            f"{problem.names[i]} = {values[i]:.3g} +- {errors[i]:.2g} ({problem.group})"
            for i in np.flatnonzero(_negated(problem, values, errors))
        ),
        converged=converged,
    )


def unknown(group: str, base: dict[str, float], reason: str) -> Estimate:
    """An estimate of which every parameter keeps its base value, for one reason."""
    kept = ", ".join(f"{name} {value:.4g}" for name, value in base.items())
    values = np.array(list(base.values()), float)
    line = f"{group}: {reason}; the base vehicle's {kept} is kept"
    return Estimate(group, tuple(base), values, np.full(len(base), np.inf), warnings=(line,))


def check_signs(estimates: Sequence[Estimate]) -> None:
    """Reject constants of an impossible sign.

    Raises:
        InputError: a constant that is significantly negative and cannot be.
    """
    wrong = [text for estimate in estimates for text in estimate.negated]
    if wrong:
        raise InputError(
            f"the fit has {', '.join(wrong)}, expected above 0: a column of that axis is negated "
            "or swapped"
        )


def half_seconds(time: np.ndarray, flight: np.ndarray | int = 0) -> np.ndarray:
    """Index (n,) of the block of half a second, of times (n,), s, in flights (n,)."""
    label = flight * 1_000_000 + np.floor(time / BLOCK).astype(int)
    return np.unique(label, return_inverse=True)[1]


def r_squared(measured: np.ndarray, modeled: np.ndarray) -> np.ndarray:
    """``1 - sum(error^2) / sum((measured - mean)^2)`` of each column."""
    spread = ((measured - measured.mean(axis=0)) ** 2).sum(axis=0)
    return 1.0 - ((measured - modeled) ** 2).sum(axis=0) / np.maximum(spread, 1e-300)


def _quality(problem: Problem, values: np.ndarray) -> tuple[float, float]:
    """R^2 over all columns of the signal, and root mean square error."""
    square = (problem.measured - problem.modeled(values)) ** 2
    spread = ((problem.measured - problem.measured.mean(axis=0)) ** 2).sum()
    explained = 1.0 - float(square.sum()) / float(spread) if spread > 0.0 else 0.0
    return explained, float(np.sqrt(square.mean()))


def _standard_errors(found: Minimum, error: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """Cluster-robust standard errors (f,), in units of ``found.size``."""
    blocks = np.repeat(blocks, len(error) // len(blocks))
    count, free = int(blocks.max()) + 1, len(found.values)
    scores = np.zeros((count, free))
    np.add.at(scores, blocks, found.jacobian * error[:, None])
    scores -= scores.mean(axis=0)  # the correction for noise shifts their mean
    freedom = count / max(1, count - free)
    covariance = freedom * found.bread @ (scores.T @ scores) @ found.bread
    return np.sqrt(np.diag(covariance))


def _without_evidence(problem: Problem, values: np.ndarray, errors: np.ndarray) -> dict[int, str]:
    """Lines on the fitted parameters that have no evidence, by their index."""
    negated, limits = _negated(problem, values, errors), problem.at_limit(values)
    lines = {}
    for i in np.flatnonzero(np.isfinite(errors)):
        size = f"{values[i]:.2g} +- {errors[i]:.1g}"
        if limits[i]:
            reason = f"{values[i]:.3g} is at the edge of the search range"
            lines[int(i)] = _kept(problem, i, reason)
        elif problem.names[i] in problem.positive and not negated[i]:
            if values[i] < 0.0:
                lines[int(i)] = _kept(problem, i, f"{size} is impossible below 0")
            elif values[i] < SIGNIFICANT * errors[i]:
                lines[int(i)] = _kept(problem, i, f"{size} is not significantly above 0")
    return lines


def _negated(problem: Problem, values: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Parameters (k,) bool that cannot be below zero, not even in part, and clearly are."""
    driving = np.array([n in problem.positive and n not in problem.small for n in problem.names])
    return driving & np.isfinite(errors) & (values < 0.0) & (values < -NEGATED * errors)


def _kept(problem: Problem, index: int, reason: str) -> str:
    name, base = problem.names[index], problem.base[index]
    return f"{name} ({problem.group}): {reason}; the base vehicle's {base:.4g} is kept"


def _condition(found: Minimum) -> float:
    size = np.sqrt((found.jacobian**2).mean(axis=0))
    return float(np.linalg.cond(found.jacobian / np.maximum(size, 1e-300)))


def _percent(error: float, value: float) -> str:
    return f"{100.0 * error / max(abs(value), 1e-300):.0f}%"
