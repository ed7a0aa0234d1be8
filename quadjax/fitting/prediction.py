"""Predictions of a fitted model, and limits on how much it may increase a flight's error."""

from typing import Self

import numpy as np
from flax import struct

from quadjax.core.mlp import Layers
from quadjax.fitting.nominal import AXES, residual_output
from quadjax.fitting.prepare import Samples
from quadjax.fitting.residual_fit import ResidualFit
from quadjax.fitting.signals import Rows, concatenated
from quadjax.fitting.tasks import nominal_error
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import Residual


@struct.dataclass
class Prediction(Rows):
    """What was measured and what a model predicts on some rows; columns as ``AXES``."""

    name: str = struct.field(pytree_node=False)  # of the rows
    rows: np.ndarray  # (n,) index into the samples
    measured: np.ndarray  # (n, 6)
    nominal: np.ndarray  # (n, 6)
    full: np.ndarray  # (n, 6) nominal plus residual

    def rmse(self, modeled: np.ndarray) -> np.ndarray:
        """Root mean square error (6,)."""
        return np.sqrt(((self.measured - modeled) ** 2).mean(axis=0))

    @property
    def change(self) -> np.ndarray:
        """Relative change (6,) of the root mean square error due to the residual."""
        return self.rmse(self.full) / np.maximum(self.rmse(self.nominal), 1e-300) - 1.0

    def scaled(self, gains: np.ndarray) -> Self:
        """The prediction with the residual's outputs times ``gains`` (4,): az, Mx, My, Mz."""
        full = self.nominal + (self.full - self.nominal) * np.concatenate([[1.0, 1.0], gains])
        return self.replace(full=full)


def predict(name: str, samples: Samples, mask: np.ndarray, fit: ResidualFit) -> Prediction:
    """Predictions of a fit on the rows of a mask (n,) bool."""
    rows = np.flatnonzero(mask)
    part = samples[rows]
    nominal = part.measured - nominal_error(part, fit.constants)
    full = nominal.copy()
    full[:, 2:] += residual_output(fit.residual, part.motion)
    return Prediction(name, rows, part.measured, nominal, full)


def pooled(predictions: list[Prediction]) -> Prediction:
    """The rows of several predictions."""
    return concatenated([part.replace(name="all") for part in predictions])


def harmless_gains(held_out: list[Prediction], max_harm: float, min_gain: float) -> np.ndarray:
    """Factors (4,), at most 1, on the residual's outputs that limit each held-out flight's error.

    With ``e`` the error of the nominal model on a flight and ``r`` the output of the residual, the
    error with a factor ``g`` is within ``1 + max_harm`` of the nominal one for

        g^2 mean(r^2) - 2 g mean(e r) <= ((1 + max_harm)^2 - 1) mean(e^2),

    so each flight allows factors up to the larger root. An output whose mean gain is then below
    ``min_gain`` gets a factor of zero.

    Args:
        held_out: predictions of flights by fits without them.
        max_harm: largest relative increase of a flight's error.
        min_gain: least relative decrease of the error, in the mean over flights.
    """
    gains = np.ones(4)
    for part in held_out:
        error = (part.measured - part.nominal)[:, 2:]
        output = (part.full - part.nominal)[:, 2:]
        cross, square = (error * output).mean(axis=0), (output**2).mean(axis=0)
        room = ((1.0 + max_harm) ** 2 - 1.0) * (error**2).mean(axis=0)
        largest = (cross + np.sqrt(cross**2 + square * room)) / np.maximum(square, 1e-300)
        gains = np.where(square > 0.0, np.minimum(gains, largest), gains)
    limited = gains < 1.0
    change = np.mean([part.scaled(gains).change[2:] for part in held_out] or [np.zeros(4)], axis=0)
    return np.where(limited & (-change < min_gain), 0.0, gains)


def limited_by_others(
    held_out: list[Prediction], max_harm: float, min_gain: float
) -> list[Prediction]:
    """Each prediction, scaled by the factors that the other ones allow; see ``harmless_gains``."""
    limited = []
    for part in held_out:
        others = [other for other in held_out if other is not part]
        limited.append(part.scaled(harmless_gains(others, max_harm, min_gain)))
    return limited


def harmful_constants(
    samples: Samples,
    held_out: dict[str, tuple[np.ndarray, MotorConstants]],
    base: MotorConstants,
    max_harm: float,
) -> dict[str, str]:
    """Axes on which fitted constants are worse than the base vehicle's, and where.

    Args:
        samples: every row.
        held_out: by flight its rows (n,) bool, and constants that are fitted without them.
        base: constants of the base vehicle.
        max_harm: largest relative increase of a flight's error.
    """
    found = {}
    for name, (rows, constants) in held_out.items():
        part = samples[rows]
        own, other = (
            np.sqrt((nominal_error(part, each) ** 2).mean(axis=0)) for each in (constants, base)
        )
        for axis, change in zip(AXES, own / np.maximum(other, 1e-300) - 1.0, strict=True):
            if change > max_harm:
                found[axis] = (
                    f"{axis}: the base vehicle's constants are kept: those fitted without {name} "
                    f"have a {100.0 * change:.0f}% larger error on it"
                )
    return found


def with_gains(residual: Residual, gains: np.ndarray) -> Residual:
    """A residual with its outputs (az, Mx, My, Mz) times ``gains`` (4,)."""

    def scaled(layers: Layers, factors: np.ndarray) -> Layers:
        kernel, bias = layers[-1]
        return (*layers[:-1], (kernel * np.float32(factors), bias * np.float32(factors)))

    return residual.replace(
        thrust=scaled(residual.thrust, gains[:1]), moment=scaled(residual.moment, gains[1:])
    )
