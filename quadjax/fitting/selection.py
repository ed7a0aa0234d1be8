"""Model selection of the residual on held-out folds.

For each axis the folds choose mirroring, the number of epochs and the shrinkage of the ensemble's
output towards zero, and whether the axis is rejected.

With ``ratio_u(s)`` the root mean square error on held-out fold ``u`` of nominal plus ``s`` times
the ensemble's mean, relative to nominal alone, the scale ``s`` in [0, 1] minimizes::

    mean_u ratio_u(s) + caution * max(0, max_u ratio_u(s) - 1)

so the worst fold counts twice where the residual increases its error, and no fold's error may
increase by more than ``max_harm``. The gain ``1 - mean_u ratio_u`` of the choice must exceed a
minimum and, with two or more seeds, its standard deviation between the seeds. Otherwise the axis is
rejected and its output is zero.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import mlp
from quadjax.core.mlp import Layers
from quadjax.fitting.config import ResidualConfig

SCALES = np.linspace(0.0, 1.0, 21)


@dataclass(frozen=True)
class FoldMoments:
    """Second moments on one held-out fold, relative to the nominal model's square error."""

    cross: np.ndarray  # (epoch, o) mean(error * ensemble mean)
    square: np.ndarray  # (epoch, o) mean(ensemble mean^2)
    seed_cross: np.ndarray  # (seed, epoch, o) the same, seed by seed
    seed_square: np.ndarray  # (seed, epoch, o)


@dataclass(frozen=True)
class Selection:
    """The selected residual of one axis."""

    axis: str
    mirror: bool
    epoch: int  # index into the training's history
    scale: float  # zero if rejected
    gains: tuple[float, ...]  # per held-out fold, before any rejection
    gain: float  # their mean
    seed_spread: float  # standard deviation of the mean gain over seeds; nan for one seed
    agreement: float  # mean square of the mean output over mean square output
    rejected: str | None  # reason


def score_fold(history: Layers, inputs: np.ndarray, errors: np.ndarray, length: int) -> FoldMoments:
    """Score one task's ensemble after every epoch on held-out rows.

    Args:
        history: layers, every leaf (seed, epoch, ..).
        inputs: (n, i) held-out rows, standardized as the task's.
        errors: (n, o) of the nominal model.
        length: number of rows after padding, the same for every fold.
    """
    padding = ((0, length - len(inputs)), (0, 0))
    size = np.sqrt((errors**2).mean(axis=0))
    scaled = errors / np.maximum(size, 1e-12)
    moments = _moments(
        history,
        jnp.asarray(np.pad(inputs, padding), jnp.float32),
        jnp.asarray(np.pad(scaled, padding), jnp.float32),
        jnp.asarray(np.arange(length) < len(inputs), jnp.float32)[:, None] / len(inputs),
    )
    cross, square, seed_cross, seed_square = (np.asarray(m, np.float64) for m in moments)
    # The moments are of outputs in the task's units; errors were divided by this fold's size.
    return FoldMoments(cross / size, square / size**2, seed_cross / size, seed_square / size**2)


@jax.jit
def _moments(
    history: Layers, inputs: jax.Array, errors: jax.Array, weight: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    def of_epoch(layers: Layers) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        outputs = jax.vmap(partial(mlp.apply, inputs=inputs))(layers)  # (seed, n, o)
        mean = outputs.mean(axis=0)
        seeds = ((weight * errors)[None] * outputs).sum(1), (weight[None] * outputs**2).sum(1)
        return (weight * errors * mean).sum(0), (weight * mean**2).sum(0), *seeds

    by_epoch = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), history)
    cross, square, seed_cross, seed_square = jax.lax.map(of_epoch, by_epoch)
    return cross, square, jnp.swapaxes(seed_cross, 0, 1), jnp.swapaxes(seed_square, 0, 1)


def select(
    axes: tuple[str, ...], candidates: dict[bool, list[FoldMoments]], config: ResidualConfig
) -> list[Selection]:
    """Select the residual of every axis of a network.

    Args:
        axes: the network's.
        candidates: scores of every held-out fold, with and without mirroring.
        config: with caution and least gain.
    """
    choices = []
    for column, axis in enumerate(axes):
        options = [
            _best(axis, column, mirror, scores, config) for mirror, scores in candidates.items()
        ]
        choices.append(min(options, key=lambda option: (bool(option[1].rejected), option[0]))[1])
    return choices


def reject_all(axes: tuple[str, ...], reason: str) -> list[Selection]:
    """Every axis rejected, without validation data."""
    return [Selection(axis, False, 0, 0.0, (), 0.0, 0.0, 0.0, reason) for axis in axes]


def _ratio(cross: np.ndarray, square: np.ndarray, scale: np.ndarray | float) -> np.ndarray:
    return np.sqrt(np.maximum(1.0 - 2.0 * scale * cross + scale**2 * square, 0.0))


def _best(
    axis: str, column: int, mirror: bool, scores: list[FoldMoments], config: ResidualConfig
) -> tuple[float, Selection]:
    """The best epoch and scale of one candidate, and its objective."""
    cross = np.stack([score.cross[:, column] for score in scores])  # (fold, epoch)
    square = np.stack([score.square[:, column] for score in scores])
    ratios = _ratio(cross[..., None], square[..., None], SCALES)  # (fold, epoch, scale)
    harm = np.maximum(ratios.max(axis=0) - 1.0, 0.0)
    objective = ratios.mean(axis=0) + config.caution * harm
    # Smoothed over neighboring epochs: the minimum of a noisy curve is biased.
    smooth = np.stack(
        [np.convolve(np.pad(o, 2, "edge"), np.ones(5) / 5, "valid") for o in objective.T], axis=1
    )
    smooth = np.where(harm > config.max_harm, np.inf, smooth)
    epoch, place = np.unravel_index(int(smooth.argmin()), smooth.shape)
    scale = float(SCALES[place])
    gains = 1.0 - ratios[:, epoch, place]
    seed_cross = np.stack([score.seed_cross[:, epoch, column] for score in scores])
    seed_square = np.stack([score.seed_square[:, epoch, column] for score in scores])
    seed_gains = 1.0 - _ratio(seed_cross, seed_square, scale).mean(axis=0)
    choice = Selection(
        axis=axis,
        mirror=mirror,
        epoch=int(epoch),
        scale=scale,
        gains=tuple(float(gain) for gain in gains),
        gain=float(gains.mean()),
        seed_spread=float(seed_gains.std(ddof=1)) if len(seed_gains) > 1 else float("nan"),
        agreement=float((square[:, epoch] / np.maximum(seed_square.mean(1), 1e-30)).mean()),
        rejected=None,
    )
    return float(smooth[epoch, place]), _reject(choice, config)


def _reject(choice: Selection, config: ResidualConfig) -> Selection:
    """The choice, rejected if it is not clearly better than the nominal model."""
    reason = None
    if choice.scale == 0.0 or choice.gain <= 0.0:
        reason = "no better than the nominal model on held-out data"
    elif choice.gain < config.min_gain:
        reason = f"a gain of {100 * choice.gain:.1f}% on held-out data is below residual.min_gain"
    elif choice.gain < choice.seed_spread:
        reason = (
            f"a gain of {100 * choice.gain:.1f}% on held-out data is below its standard deviation "
            f"between seeds of the training, {100 * choice.seed_spread:.1f}%"
        )
    if reason is None:
        return choice
    return replace(choice, scale=0.0, rejected=reason)
