"""Least squares with cluster-robust standard errors, for every model that a fit has.

Neighboring samples of a filtered signal are correlated, so standard errors that assume independent
rows are too small. Rows are grouped into blocks of half a second of one flight, whose scores give
the covariance (Liang and Zeger, 1986).

A parameter without evidence keeps its value of the base vehicle, and the others are fitted again:
one that the logs do not determine (a column that is zero or a combination of others), one that
cannot be below zero and is not ``SIGNIFICANT`` standard errors above it, and one at a limit of the
search. All of a problem keep it that explain too little of the signal. A base value that is more
than ``EXCLUDED`` standard errors from the estimate is not kept: the estimate is used, or zero if it
is below.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.solvers import Minimum, linear, nonlinear

BLOCK_S = 0.5
SIGNIFICANT = 2.0  # standard errors above zero
EXCLUDED = 3.0  # standard errors between an estimate and a base value that the logs exclude
NEGATED = 3.0  # standard errors below zero, from which on a column of the log must be wrong
CONDITION = 1e6  # condition number (of columns of unit size) above which they are collinear
LITTLE_EXPLAINED = 0.1  # R^2 below which there is a warning
UNCERTAIN = 0.05  # relative standard error above which a parameter has a warning
AT_LIMIT = 0.01  # relative distance to a limit of the search
MAX_STEPS = 40  # of the solver


@dataclass(frozen=True)
class Estimate:
    """The fitted parameters of one problem."""

    group: str  # that they belong to: an axis, or what they describe
    constants: dict[str, float]  # values of the parameters, by name
    errors: dict[str, float]  # their standard errors, infinite where the base value is kept
    # of the columns, each scaled to unit size; infinite with a kept base value
    condition: float = np.inf
    r_squared: float = 0.0  # of the signal, over all its columns
    rmse: float = np.nan  # of the signal
    warnings: tuple[str, ...] = ()  # one line each
    negated: tuple[str, ...] = ()  # parameters that are significantly below zero and cannot be
    converged: bool = True  # false if the solver stopped at its limit of steps


class Parameter(NamedTuple):
    """A parameter, and what is known about it before the fit."""

    name: str
    base: float  # value without evidence, with which a search starts
    low: float = -np.inf  # limits of the search of a nonlinear problem
    high: float = np.inf
    size: float = 1.0  # typical value in a nonlinear problem
    positive: bool = False  # cannot be below zero
    # May absorb what the model lacks, so that even a value significantly below zero does not mean
    # that a column of the log is wrong.
    small: bool = False
    physical: bool = False  # its limits are those of the model, not of the search
    fixed: bool = False  # the signal does not determine it


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Parameters, and the signal that they have to explain.

    A linear problem has columns and their noise; its signal is the sum of parameters times columns.
    Noise in a column adds to the diagonal of the normal equations and biases its parameter towards
    zero; that part is subtracted (bias-compensated least squares). Any other problem has a model.
    """

    group: str  # that the parameters belong to: an axis, or what they describe
    parameters: Sequence[Parameter]  # k of them
    measured: np.ndarray  # (n,) or (n, m) signal
    blocks: np.ndarray  # (n,) index of the half second of one flight; see ``half_seconds``
    columns: np.ndarray | None = None  # (n, k) of a linear problem
    noise: np.ndarray | None = None  # (n, k) change of the columns by added noise; see ``prepare``
    # parameters (k,) -> what they give, of the shape of the signal
    model: Callable[[np.ndarray], np.ndarray] | None = None
    uncertain: float = UNCERTAIN  # relative standard error above which a parameter has a warning
    least_explained: float = -np.inf  # R^2 below which all parameters keep their base values

    def modeled(self, values: np.ndarray) -> np.ndarray:
        """What parameters (k,) give, of the shape of the signal."""
        if self.model is not None:
            return self.model(values)
        assert self.columns is not None
        return self.columns @ values


def solve(problem: Problem) -> Estimate:
    """The parameters of a problem, with base values where the logs have no evidence."""
    base = np.array([parameter.base for parameter in problem.parameters])
    free, names = _determined(problem), [parameter.name for parameter in problem.parameters]
    reasons = dict.fromkeys(np.flatnonzero(~free).tolist(), "the logs do not determine it")
    zero: dict[int, float] = {}  # standard errors of those that are zero in place of below
    while True:
        values, errors, minimum = _solution(problem, base, free)
        doubtful = _without_evidence(problem, values, errors)
        if not doubtful:
            break
        reasons |= doubtful
        free[list(doubtful)] = False
        below = _excluded(problem, values, errors) & (values < 0.0)
        zero |= {i: float(errors[i]) for i in doubtful if below[i]}
        base[list(zero)] = 0.0
    errors[list(zero)] = list(zero.values())
    square = (problem.measured - problem.modeled(values)) ** 2
    spread = float(((problem.measured - problem.measured.mean(axis=0)) ** 2).sum())
    explained = 1.0 - float(square.sum()) / spread if spread > 0.0 else 0.0
    if free.any() and explained < problem.least_explained:
        reason = f"it explains {max(explained, 0.0):.0%} of the signal in the logs"
        reasons |= dict.fromkeys(np.flatnonzero(free).tolist(), reason)
        values = np.array([parameter.base for parameter in problem.parameters])
        errors = np.full(len(base), np.inf)
    condition = np.inf
    if minimum is not None and free.all():
        size = np.sqrt((minimum.jacobian**2).mean(axis=0))
        condition = float(np.linalg.cond(minimum.jacobian / np.maximum(size, 1e-300)))
    return Estimate(
        group=problem.group,
        constants=dict(zip(names, values.tolist(), strict=True)),
        errors=dict(zip(names, errors.tolist(), strict=True)),
        condition=condition,
        r_squared=explained,
        rmse=float(np.sqrt(square.mean())),
        warnings=tuple(_warnings(problem, reasons, values, errors, explained, minimum)),
        negated=tuple(names[i] for i in np.flatnonzero(_negated(problem, values, errors))),
        converged=minimum is None or minimum.converged,
    )


def unknown(group: str, base: dict[str, float], reason: str) -> Estimate:
    """An estimate of which every parameter keeps its base value, for one reason."""
    kept = ", ".join(f"{name} {value:.4g}" for name, value in base.items())
    line = f"{group}: {reason}; the base vehicle's {kept} is kept"
    return Estimate(group, base, dict.fromkeys(base, np.inf), warnings=(line,))


def check_signs(estimates: Sequence[Estimate]) -> None:
    """Reject constants of an impossible sign.

    Raises:
        InputError: a constant that is significantly negative and cannot be.
    """
    wrong = [
        f"{name} = {fit.constants[name]:.3g} +- {fit.errors[name]:.2g} ({fit.group})"
        for fit in estimates
        for name in fit.negated
    ]
    if wrong:
        raise InputError(
            f"the fit has {', '.join(wrong)}, expected above 0: a column of that axis is negated "
            "or swapped"
        )


def half_seconds(times: Sequence[np.ndarray]) -> np.ndarray:
    """Index (n,) of the block of half a second, of the times (n_i,), s, of several flights."""
    flight = np.repeat(np.arange(len(times)), [len(time) for time in times])
    label = flight * 1_000_000 + np.floor(np.concatenate(times) / BLOCK_S).astype(int)
    return np.unique(label, return_inverse=True)[1]


def r_squared(measured: np.ndarray, modeled: np.ndarray) -> np.ndarray:
    """``1 - sum(error^2) / sum((measured - mean)^2)`` of each column."""
    spread = ((measured - measured.mean(axis=0)) ** 2).sum(axis=0)
    return 1.0 - ((measured - modeled) ** 2).sum(axis=0) / np.maximum(spread, 1e-300)


def _determined(problem: Problem) -> np.ndarray:
    """Parameters (k,) bool that are not fixed, with columns that no others combine to."""
    free = np.array([not parameter.fixed for parameter in problem.parameters])
    if problem.columns is None:
        return free
    size = np.sqrt((problem.columns**2).mean(axis=0))
    free &= size > 1e-12
    for index in np.flatnonzero(free):
        first = free & (np.arange(len(free)) <= index)
        free[index] = np.linalg.cond(problem.columns[:, first] / size[first]) < CONDITION
    return free


def _solution(
    problem: Problem, base: np.ndarray, free: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Minimum | None]:
    """Values and standard errors (k,), and the minimum, None without free parameters."""
    values, errors = base.copy(), np.full(len(base), np.inf)
    if not free.any():
        return values, errors, None
    minimum = _minimum(problem, base, free)
    scaled, unit, jacobian, bread = minimum[:4]
    values[free] = scaled * unit
    error = (problem.measured - problem.modeled(values)).ravel()
    blocks = np.repeat(problem.blocks, len(error) // len(problem.blocks))
    count = int(blocks.max()) + 1
    scores = np.zeros((count, len(scaled)))
    np.add.at(scores, blocks, jacobian * error[:, None])
    scores -= scores.mean(axis=0)  # the correction for noise shifts their mean
    freedom = count / max(1, count - len(scaled))
    covariance = freedom * bread @ (scores.T @ scores) @ bread
    errors[free] = np.sqrt(np.maximum(np.diag(covariance), 0.0)) * unit  # of rounding errors
    return values, errors, minimum


def _minimum(problem: Problem, base: np.ndarray, free: np.ndarray) -> Minimum:
    if problem.model is None:
        assert problem.columns is not None and problem.noise is not None
        remainder = problem.measured - problem.columns[:, ~free] @ base[~free]
        return linear(problem.columns[:, free], problem.noise[:, free], remainder)
    low, high, unit = np.array([(p.low, p.high, p.size) for p in problem.parameters]).T[:, free]

    def error(some: np.ndarray) -> np.ndarray:
        values = base.copy()
        values[free] = some
        return (problem.modeled(values) - problem.measured).ravel()

    return nonlinear(error, base[free], (low, high), unit, MAX_STEPS)


def _without_evidence(problem: Problem, values: np.ndarray, errors: np.ndarray) -> dict[int, str]:
    """Why fitted parameters have no evidence, by their index."""
    reasons, negated = {}, _negated(problem, values, errors)
    excluded = _excluded(problem, values, errors)
    for i in np.flatnonzero(np.isfinite(errors)).tolist():
        parameter, size = problem.parameters[i], f"{values[i]:.2g} +- {errors[i]:.1g}"
        at_limit = np.isclose(values[i], (parameter.low, parameter.high), rtol=AT_LIMIT, atol=0.0)
        if at_limit.any() and not parameter.physical:
            reasons[i] = f"{values[i]:.3g} is at the edge of the search range"
        elif not parameter.positive or negated[i]:
            continue
        elif values[i] < 0.0:
            reasons[i] = f"{size} is impossible below 0"
        elif values[i] < SIGNIFICANT * errors[i] and not excluded[i]:
            reasons[i] = f"{size} is not significantly above 0"
    return reasons


def _excluded(problem: Problem, values: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Parameters (k,) bool whose base value is impossible by the logs.

    One that may absorb what the model lacks, and is clearly below zero, does so, and says nothing
    of its true value.
    """
    base = np.array([parameter.base for parameter in problem.parameters])
    small = np.array([parameter.small for parameter in problem.parameters])
    absorbing = small & (values < -NEGATED * errors)
    return np.isfinite(errors) & (np.abs(base - values) > EXCLUDED * errors) & ~absorbing


def _negated(problem: Problem, values: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Parameters (k,) bool that cannot be below zero, not even in part, and clearly are."""
    driving = np.array([p.positive and not p.small for p in problem.parameters])
    return driving & np.isfinite(errors) & (values < 0.0) & (values < -NEGATED * errors)


def _warnings(
    problem: Problem,
    reasons: dict[int, str],
    values: np.ndarray,
    errors: np.ndarray,
    explained: float,
    minimum: Minimum | None,
) -> Iterator[str]:
    labels = [f"{parameter.name} ({problem.group})" for parameter in problem.parameters]
    for i, reason in reasons.items():
        value = f"the base vehicle's {problem.parameters[i].base:.4g}"
        kept = (
            f"0 is used: the logs exclude {value}" if np.isfinite(errors[i]) else f"{value} is kept"
        )
        yield f"{labels[i]}: {reason}; {kept}"
    if explained < LITTLE_EXPLAINED:
        yield f"{problem.group}: R^2 is {explained:.2f}: the model explains little"
    with np.errstate(invalid="ignore"):
        uncertain = np.isfinite(errors) & (errors > problem.uncertain * np.abs(values))
        uncertain[list(reasons)] = False
    for i in np.flatnonzero(uncertain).tolist():
        yield (
            f"{labels[i]}: little excited by the logs, or the model does not fit them: "
            f"{values[i]:.4g} +- {100.0 * errors[i] / max(abs(values[i]), 1e-300):.0f}%"
        )
    if minimum is not None and minimum.hidden:
        yield (
            f"{problem.group}: what tells its constants apart is little but noise of the signals, "
            "which is not compensated: they may be too small"
        )
    if minimum is not None and not minimum.converged:
        steps = f"the solver stopped after {MAX_STEPS} steps, before it converged"
        yield f"{problem.group}: {steps}"
