"""Training data of the residual networks: inputs, errors of the nominal model, and weights.

A network is trained many times, each time without some folds. Every such *task* has its own nominal
model and scaling, so that it contains no information of the folds left out.
"""

from dataclasses import dataclass

import numpy as np

from quadjax.fitting.config import NominalConfig, ResidualConfig
from quadjax.fitting.least_squares import fit_nominal, with_fit
from quadjax.fitting.nominal import AXES, EQUATIONS, Constants, file_inputs
from quadjax.fitting.prepare import Samples
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.motor import MotorConstants


@dataclass(frozen=True)
class ResidualNetwork:
    """One of the two residual networks: its axes and its mirror symmetry."""

    name: str
    axes: tuple[str, ...]
    inputs: int
    # Left and right swapped: motors 1 <-> 2 and 3 <-> 4, and vy, p, r, Mx, Mz change sign.
    mirror_order: tuple[int, ...]
    mirror_sign: tuple[float, ...]
    mirror_output: tuple[float, ...]

    @property
    def columns(self) -> list[int]:
        """Indices of its axes in ``AXES``."""
        return [AXES.index(axis) for axis in self.axes]

    def hidden(self, config: ResidualConfig) -> int:
        """Number of hidden units."""
        return getattr(config, f"hidden_{self.name}")


_ORDER = (1, 0, 3, 2, 4, 5, 6)
_SIGN = (1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0)
NETWORKS = {
    "thrust": ResidualNetwork("thrust", ("az",), 7, _ORDER, _SIGN, (1.0,)),
    "moment": ResidualNetwork(
        "moment",
        ("Mx", "My", "Mz"),
        10,
        (*_ORDER, 7, 8, 9),
        (*_SIGN, -1.0, 1.0, -1.0),
        (-1.0, 1.0, -1.0),
    ),
}


@dataclass(frozen=True)
class Task:
    """One training: some folds left out, with or without mirroring."""

    left_out: frozenset[int]
    mirror: bool
    constants: MotorConstants  # nominal model of the rows that are not left out
    inputs: np.ndarray  # (n, i) standardized
    errors: np.ndarray  # (n, o) standardized
    weights: np.ndarray  # (n, o) the same total per fold
    center: np.ndarray  # (i,) of the inputs, file units
    scale: np.ndarray  # (i,)
    low: np.ndarray  # (i,) range of the inputs, file units
    high: np.ndarray  # (i,)
    error_scale: np.ndarray  # (o,) root mean square error of the nominal model


def mirrored(network: ResidualNetwork, inputs: np.ndarray) -> np.ndarray:
    """Inputs (n, i) of the mirrored flight."""
    return inputs[:, list(network.mirror_order)] * np.array(network.mirror_sign)


def nominal_without(
    samples: Samples,
    fold: np.ndarray,
    left_out: frozenset[int],
    base: MotorConstants,
    config: NominalConfig,
) -> MotorConstants:
    """The nominal model fitted without some folds; the base's on axes that are not fitted."""
    if not config.fit:
        return base
    fits = fit_nominal(samples[learned_rows(fold, left_out)], base, config.any_sign)
    return with_fit(base, [fit for fit in fits if fit.axis in config.axes])


def learned_rows(fold: np.ndarray, left_out: frozenset[int]) -> np.ndarray:
    """Rows (n,) bool of all folds but some, without test rows."""
    return (fold >= 0) & ~np.isin(fold, list(left_out))


def nominal_error(samples: Samples, constants: Constants) -> np.ndarray:
    """Measured minus nominal (n, 6), as ``AXES``."""
    values = values_of(constants)
    modeled = [
        samples.regressors[axis]
        @ np.array([float(values[name]) for name in EQUATIONS[type(constants)].constants[axis]])
        for axis in AXES
    ]
    return samples.measured - np.stack(modeled, axis=1)


def make_task(
    network: ResidualNetwork,
    samples: Samples,
    fold: np.ndarray,
    left_out: frozenset[int],
    mirror: bool,
    constants: MotorConstants,
    rpm_range: tuple[float, float],
) -> Task:
    """The rows of one training, standardized by themselves."""
    rows = learned_rows(fold, left_out)
    inputs = file_inputs(samples.motion[rows], rpm_range)[:, : network.inputs]
    errors = nominal_error(samples[rows], constants)[:, network.columns]
    seen = np.concatenate([inputs, mirrored(network, inputs)]) if mirror else inputs
    center, scale = seen.mean(axis=0), np.maximum(seen.std(axis=0), 1e-6)
    error_scale = np.maximum(np.sqrt((errors**2).mean(axis=0)), 1e-12)
    weights = np.ones_like(errors)
    for number in np.unique(fold[rows]):
        here = fold[rows] == number
        weights[here] = error_scale**2 / np.maximum((errors[here] ** 2).mean(axis=0), 1e-24)
    return Task(
        left_out=left_out,
        mirror=mirror,
        constants=constants,
        inputs=(inputs - center) / scale,
        errors=errors / error_scale,
        weights=weights / weights.mean(axis=0),
        center=center,
        scale=scale,
        low=seen.min(axis=0),
        high=seen.max(axis=0),
        error_scale=error_scale,
    )
