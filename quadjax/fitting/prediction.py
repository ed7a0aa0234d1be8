"""Predictions of a fitted model on rows that it was fitted to, or without."""

import numpy as np
from flax import struct

from quadjax.fitting.axes import nominal_error
from quadjax.fitting.nominal import Constants, residual_output
from quadjax.fitting.prepare import Samples
from quadjax.fitting.signals import Rows, concatenated
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


def predict(
    name: str,
    samples: Samples,
    mask: np.ndarray,
    constants: Constants,
    residual: Residual | None = None,
) -> Prediction:
    """Predictions of a model on the rows of a mask (n,) bool."""
    rows = np.flatnonzero(mask)
    part = samples[rows]
    nominal = part.measured - nominal_error(part, constants)
    full = nominal.copy()
    if residual is not None:
        full[:, 2:] += residual_output(residual, part.motion)
    return Prediction(name, rows, part.measured, nominal, full)


def pooled(predictions: list[Prediction]) -> Prediction:
    """The rows of several predictions."""
    return concatenated([part.replace(name="all") for part in predictions])
