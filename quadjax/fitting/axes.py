"""Fit of the constants of forces and moments, axis by axis, and what a model predicts."""

import dataclasses
from collections.abc import Sequence, Set
from typing import Self, TypeVar

import numpy as np
from flax import struct

from quadjax.fitting.nominal import AXES, EQUATIONS, Constants, residual_output
from quadjax.fitting.regression import Estimate, Parameter, Problem, half_seconds, solve
from quadjax.fitting.samples import Samples
from quadjax.fitting.signals import Rows, concatenated
from quadjax.vehicle.constants import replaced, values_of
from quadjax.vehicle.racing import RacingConstants
from quadjax.vehicle.residual import Residual

Fitted = TypeVar("Fitted", bound=Constants)
SEPARATED = 0.8  # of the R^2, below which common constants do not explain what single ones do
ROTORS = "1234"  # ends of the names of a constant of each rotor


def fit_axes(samples: Samples, base: Constants, shared: Set[str] = frozenset()) -> list[Estimate]:
    """Fit every axis of a nominal model.

    Args:
        samples: see ``prepare``, of the same model.
        base: values of constants without evidence; their type selects the model.
        shared: names of constants whose base value is that common to the rotors of these samples.
    """
    equations, values = EQUATIONS[type(base)], values_of(base)
    numbers = np.unique(samples.flight)
    blocks = half_seconds([samples.time[samples.flight == number] for number in numbers])

    def parameter(name: str) -> Parameter:
        positive, small = name not in equations.either_sign, name in equations.small
        return Parameter(name, float(values[name]), positive=positive, small=small)

    return [
        _solve_axis(
            Problem(
                group=axis,
                parameters=[parameter(name) for name in names],
                measured=samples.measured[:, AXES.index(axis)],
                blocks=blocks,
                uncertain=equations.uncertain,
                columns=samples.regressors[axis],
                noise=samples.noise[axis],
            ),
            shared,
        )
        for axis, names in equations.constants.items()
    ]


def _solve_axis(problem: Problem, shared: Set[str]) -> Estimate:
    """An axis, with values common to the rotors for those that the flight does not separate.

    Rotors that move together, and a moment that the model lacks, give constants of an impossible
    sign. Unlike those of swapped columns, they explain little that the common values do not.
    """
    free = estimate = solve(problem)
    fixed: set[str] = set()
    while wrong := shared & set(estimate.negated):
        fixed |= wrong
        parameters = [p._replace(fixed=p.name in fixed) for p in problem.parameters]
        estimate = solve(dataclasses.replace(problem, parameters=parameters))
    if not fixed or estimate.r_squared < SEPARATED * free.r_squared:
        return free
    lines = [line for line in estimate.warnings if line.partition(" (")[0] not in fixed]
    lines += [
        f"{name} ({problem.group}): {free.constants[name]:.2g} +- {free.errors[name]:.1g} is "
        "impossible below 0; the flight does not tell the rotors apart, and the value common to "
        f"them, {estimate.constants[name]:.4g}, is used"
        for name in sorted(fixed)
    ]
    return dataclasses.replace(estimate, warnings=tuple(lines))


def with_estimates(base: Fitted, estimates: Sequence[Estimate]) -> Fitted:
    """The base vehicle's constants with the fitted ones replaced."""
    known = values_of(base)
    fitted = {name: x for estimate in estimates for name, x in estimate.constants.items()}
    return replaced(base, {name: x for name, x in fitted.items() if name in known})


def nominal_error(samples: Samples, constants: Constants) -> np.ndarray:
    """Measured minus nominal (n, 6), as ``AXES``."""
    values, axes = values_of(constants), EQUATIONS[type(constants)].constants
    modeled = [
        samples.regressors[axis] @ np.array([float(values[name]) for name in axes[axis]])
        for axis in AXES
    ]
    return samples.measured - np.stack(modeled, axis=1)


def fit_shared_constants(samples: Samples) -> dict[str, float]:
    """Constants of the rotors of a racing quadcopter, by name, of values common to all four.

    They are the values of rotors that the logs do not tell apart. Common values that are not above
    zero are left out.
    """
    shared: dict[str, float] = {}
    for axis, names in EQUATIONS[RacingConstants].constants.items():
        stems = list(dict.fromkeys(name.rstrip(ROTORS) for name in names))
        if len(stems) == len(names):
            continue
        of_stem = [[name.rstrip(ROTORS) == stem for name in names] for stem in stems]
        columns = np.stack([samples.regressors[axis][:, mask].sum(axis=1) for mask in of_stem], 1)
        # About their means: unequal rotors balance each other in hover.
        columns, target = columns - columns.mean(axis=0), samples.measured[:, AXES.index(axis)]
        size = np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-12)
        values = np.linalg.lstsq(columns / size, target - target.mean(), rcond=1e-6)[0] / size
        for stem, value in zip(stems, values, strict=True):
            shared |= {f"{stem}{rotor}": float(value) for rotor in ROTORS if value > 0.0}
    return shared


class Prediction(struct.PyTreeNode, Rows):
    """What was measured and what a model predicts on some rows; columns as ``AXES``."""

    name: str = struct.field(pytree_node=False)  # of the rows
    rows: np.ndarray  # (n,) index into the samples
    measured: np.ndarray  # (n, 6)
    nominal: np.ndarray  # (n, 6)
    full: np.ndarray  # (n, 6) nominal plus residual

    @classmethod
    def of(
        cls,
        name: str,
        samples: Samples,
        mask: np.ndarray,
        constants: Constants,
        residual: Residual | None = None,
    ) -> Self:
        """Predictions of a model on the rows of a mask (n,) bool."""
        rows = np.flatnonzero(mask)
        part = samples[rows]
        nominal = part.measured - nominal_error(part, constants)
        full = nominal.copy()
        if residual is not None:
            full[:, 2:] += residual_output(residual, part.motion)
        return cls(name, rows, part.measured, nominal, full)

    def rmse(self, modeled: np.ndarray) -> np.ndarray:
        """Root mean square error (6,)."""
        return np.sqrt(((self.measured - modeled) ** 2).mean(axis=0))

    @property
    def change(self) -> np.ndarray:
        """Relative change (6,) of the root mean square error due to the residual."""
        return self.rmse(self.full) / np.maximum(self.rmse(self.nominal), 1e-300) - 1.0


def pooled(predictions: Sequence[Prediction]) -> Prediction:
    """The rows of several predictions."""
    return concatenated([part.replace(name="all") for part in predictions])
