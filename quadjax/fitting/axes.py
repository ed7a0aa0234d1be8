"""Fit of the constants of forces and moments, axis by axis."""

from typing import TypeVar

import numpy as np

from quadjax.core.vectors import Rotors
from quadjax.fitting.nominal import AXES, EQUATIONS, Constants
from quadjax.fitting.prepare import Samples
from quadjax.fitting.regression import Estimate, Linear, half_seconds, solve
from quadjax.vehicle.constants import replaced, values_of
from quadjax.vehicle.racing import RacingConstants

Fitted = TypeVar("Fitted", bound=Constants)
ROTORS = "1234"  # ends of the names of a constant of each rotor


def fit_axes(samples: Samples, base: Constants) -> list[Estimate]:
    """Fit every axis of a nominal model.

    Args:
        samples: see ``prepare``, of the same model.
        base: values of constants without evidence; their type selects the model.
    """
    blocks = half_seconds(samples.time, samples.flight)
    return [fit_axis(axis, samples, blocks, base) for axis in EQUATIONS[type(base)].constants]


def fit_axis(axis: str, samples: Samples, blocks: np.ndarray, base: Constants) -> Estimate:
    """Fit one axis; see ``fit_axes``."""
    equations = EQUATIONS[type(base)]
    names, known = equations.constants[axis], values_of(base)
    problem = Linear(
        group=axis,
        names=names,
        base=np.array([float(known[name]) for name in names]),
        measured=samples.measured[:, AXES.index(axis)],
        blocks=blocks,
        positive=(*equations.driving, *equations.small),
        small=equations.small,
        uncertain=equations.uncertain,
        columns=samples.regressors[axis],
        noise=samples.noise[axis],
    )
    return solve(problem)


def with_estimates(base: Fitted, estimates: list[Estimate]) -> Fitted:
    """The base vehicle's constants with the fitted ones replaced."""
    fitted = {name: x for estimate in estimates for name, x in estimate.constants.items()}
    return replaced(base, fitted)


def nominal_error(samples: Samples, constants: Constants) -> np.ndarray:
    """Measured minus nominal (n, 6), as ``AXES``."""
    values, axes = values_of(constants), EQUATIONS[type(constants)].constants
    modeled = [
        samples.regressors[axis] @ np.array([float(values[name]) for name in axes[axis]])
        for axis in AXES
    ]
    return samples.measured - np.stack(modeled, axis=1)


def with_common(samples: Samples, base: RacingConstants) -> RacingConstants:
    """The base vehicle's constants with those of the rotors replaced by ones common to all four.

    They are the values of rotors that the logs do not tell apart. Common values that are not above
    zero are not used.
    """
    common = {}
    for axis, names in EQUATIONS[RacingConstants].constants.items():
        stems = list(dict.fromkeys(name.rstrip(ROTORS) for name in names))
        if len(stems) == len(names):
            continue
        of_stem = [[name.rstrip(ROTORS) == stem for name in names] for stem in stems]
        columns = np.stack([samples.regressors[axis][:, own].sum(axis=1) for own in of_stem], 1)
        # About their means: unequal rotors balance each other in hover.
        columns, target = columns - columns.mean(axis=0), samples.measured[:, AXES.index(axis)]
        size = np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-12)
        values = np.linalg.lstsq(columns / size, target - target.mean(), rcond=1e-6)[0] / size
        common |= {s: Rotors.same(float(x)) for s, x in zip(stems, values, strict=True) if x > 0.0}
    return base.replace(**common)
