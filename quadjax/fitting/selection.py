"""Model selection of the residual on held-out folds.

For each axis the folds choose mirroring, the number of epochs and the shrinkage of the ensemble's
output towards zero, and whether the axis is rejected.

With ``ratio_u(s)`` the root mean square error on held-out fold ``u`` of nominal plus ``s`` times
the ensemble's mean, relative to nominal alone, the scale ``s`` in [0, 1] minimizes::

    mean_u ratio_u(s) + max(0, max_u ratio_u(s) - 1)

so the worst fold counts twice where the residual increases its error, and no fold's error may
increase by more than ``residual.max_harm``. The gain ``1 - mean_u ratio_u`` of the choice must
exceed ``MIN_GAIN`` and, with two or more seeds, its standard deviation between the seeds.
Otherwise the axis is rejected and its output is zero.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import mlp
from quadjax.core.mlp import Layers

SCALES = np.linspace(0.0, 1.0, 21)
MIN_GAIN = 0.01  # least relative gain on held-out data
SMOOTHED = 5  # epochs: the minimum of a noisy curve is biased
ENSEMBLE = 0  # index of the mean of all seeds among the members


@dataclass(frozen=True)
class Choice:
    """The selected residual of one axis.

    Attributes:
        axis: of ``AXES``.
        mirror: whether it is trained on mirror images.
        epoch: index into the training's history.
        scale: of the output; zero if rejected.
        gains: of each held-out fold, before any rejection.
        gain: their mean.
        seed_spread: standard deviation of the mean gain over seeds; nan for one seed.
        agreement: mean square of the mean output over mean square output.
        rejected: the reason; None if accepted.
    """

    axis: str
    mirror: bool = False
    epoch: int = 0
    scale: float = 0.0
    gains: tuple[float, ...] = ()
    gain: float = 0.0
    seed_spread: float = 0.0
    agreement: float = 0.0
    rejected: str | None = None


def fold_scores(history: Layers, inputs: np.ndarray, errors: np.ndarray, length: int) -> np.ndarray:
    """Second moments of a training on a held-out fold, relative to the nominal square error.

    Args:
        history: layers, every leaf (seed, epoch, ..).
        inputs: (n, i) held-out rows, standardized as the task's.
        errors: (n, o) of the nominal model.
        length: number of rows after padding, the same for every fold.

    Returns:
        (epoch, member, o, 2): mean error times output, and mean square output. The first member is
        the mean of all seeds, the others are the seeds.
    """
    padding = ((0, length - len(inputs)), (0, 0))
    size = np.sqrt((errors**2).mean(axis=0))
    moments = _moments(
        history,
        jnp.asarray(np.pad(inputs, padding), jnp.float32),
        jnp.asarray(np.pad(errors / np.maximum(size, 1e-12), padding), jnp.float32),
        jnp.asarray(np.arange(length) < len(inputs), jnp.float32)[:, None] / len(inputs),
    )
    # Outputs are in the task's units; errors were divided by this fold's size.
    return np.asarray(moments, np.float64) / np.stack([size, size**2], axis=-1)


@jax.jit
def _moments(history: Layers, inputs: jax.Array, errors: jax.Array, weight: jax.Array) -> jax.Array:
    def of_epoch(layers: Layers) -> jax.Array:
        outputs = jax.vmap(partial(mlp.apply, inputs=inputs))(layers)  # (seed, n, o)
        members = jnp.concatenate([outputs.mean(axis=0)[None], outputs])
        cross, square = (weight * errors * members).sum(1), (weight * members**2).sum(1)
        return jnp.stack([cross, square], axis=-1)

    return jax.lax.map(of_epoch, jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), history))


def select(
    axes: tuple[str, ...], candidates: dict[bool, np.ndarray], max_harm: float
) -> list[Choice]:
    """Select the residual of every axis of a network.

    Args:
        axes: the network's.
        candidates: scores (fold, epoch, member, o, 2) with and without mirroring.
        max_harm: largest relative increase of any fold's error.
    """
    choices = []
    for column, axis in enumerate(axes):
        options = [
            _best(axis, mirror, scores[..., column, :], max_harm)
            for mirror, scores in candidates.items()
        ]
        choices.append(min(options, key=lambda option: (bool(option[1].rejected), option[0]))[1])
    return choices


def _ratio(scores: np.ndarray, scale: np.ndarray | float) -> np.ndarray:
    """Error with a scaled output over that without, of scores (.., 2)."""
    cross, square = scores[..., 0], scores[..., 1]
    return np.sqrt(np.maximum(1.0 - 2.0 * scale * cross + scale**2 * square, 0.0))


def _best(axis: str, mirror: bool, scores: np.ndarray, max_harm: float) -> tuple[float, Choice]:
    """The best epoch and scale of one candidate (fold, epoch, member, 2), and its objective."""
    ratios = _ratio(scores[:, :, ENSEMBLE, None, :], SCALES)  # (fold, epoch, scale)
    harm = np.maximum(ratios.max(axis=0) - 1.0, 0.0)
    window, reach = np.ones(SMOOTHED) / SMOOTHED, SMOOTHED // 2
    smooth = np.stack(
        [
            np.convolve(np.pad(objective, reach, "edge"), window, "valid")
            for objective in (ratios.mean(axis=0) + harm).T
        ],
        axis=1,
    )
    smooth = np.where(harm > max_harm, np.inf, smooth)
    epoch, place = np.unravel_index(int(smooth.argmin()), smooth.shape)
    scale = float(SCALES[place])
    gains = 1.0 - ratios[:, epoch, place]
    seeds = scores[:, epoch, ENSEMBLE + 1 :]  # (fold, seed, 2)
    seed_gains = 1.0 - _ratio(seeds, scale).mean(axis=0)
    square = scores[:, epoch, ENSEMBLE, 1]
    choice = Choice(
        axis=axis,
        mirror=mirror,
        epoch=int(epoch),
        scale=scale,
        gains=tuple(float(gain) for gain in gains),
        gain=float(gains.mean()),
        seed_spread=float(seed_gains.std(ddof=1)) if len(seed_gains) > 1 else float("nan"),
        agreement=float((square / np.maximum(seeds[..., 1].mean(1), 1e-30)).mean()),
    )
    return float(smooth[epoch, place]), _checked(choice)


def _checked(choice: Choice) -> Choice:
    """The choice, rejected if it is not clearly better than the nominal model."""
    gain, reason = f"a gain of {100 * choice.gain:.1f}% on held-out data", None
    if choice.scale == 0.0 or choice.gain <= 0.0:
        reason = "no better than the nominal model on held-out data"
    elif choice.gain < MIN_GAIN:
        reason = f"{gain} is below {100 * MIN_GAIN:g}%"
    elif choice.gain < choice.seed_spread:
        spread = f"its standard deviation between seeds, {100 * choice.seed_spread:.1f}%"
        reason = f"{gain} is below {spread}"
    return choice if reason is None else replace(choice, scale=0.0, rejected=reason)
