"""How much of a residual to believe: chosen on flights that took no part in its training.

For each axis the held-out folds decide four things: whether to learn from mirror images as well,
when to stop, how far to shrink the ensemble's output towards zero, and whether to refuse it.

With ``ratio_u(s)`` the root mean square error on held-out fold ``u`` of nominal plus ``s`` times
the ensemble's mean, relative to nominal alone, the scale ``s`` in [0, 1] minimises::

    mean_u ratio_u(s) + caution * max(0, max_u ratio_u(s) - 1)

so a gain on average counts, and the worst harm counts once more. The gain ``1 - mean_u ratio_u`` of
what is chosen must exceed a minimum, and must exceed its own spread over the seeds: a gain that one
seed has and the next has not is luck. Else the axis is refused and its output is zero.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.train import Params, predict

SCALES = np.linspace(0.0, 1.0, 21)


@dataclass(frozen=True)
class Score:
    """Second moments on one held-out fold, relative to the nominal model's square error."""

    cross: np.ndarray  # (epoch, o) mean(error * ensemble mean)
    square: np.ndarray  # (epoch, o) mean(ensemble mean^2)
    seed_cross: np.ndarray  # (seed, epoch, o) the same, seed by seed
    seed_square: np.ndarray  # (seed, epoch, o)


@dataclass(frozen=True)
class Choice:
    """What the held-out folds say about one axis."""

    axis: str
    mirror: bool
    epoch: int  # index into the training's history
    scale: float  # zero where it is refused
    gains: tuple[float, ...]  # per held-out fold, at the chosen scale before any refusal
    gain: float  # their mean
    seed_spread: float  # standard deviation over seeds of a single network's mean gain
    agreement: float  # share of the members' mean square output that they have in common
    refused: str | None  # why


def score_fold(history: Params, inputs: np.ndarray, errors: np.ndarray, length: int) -> Score:
    """Score one task's ensemble after every epoch on rows that it was not trained on.

    Args:
        history: weights, every leaf (seed, epoch, ..).
        inputs: (n, i) held-out rows, standardised as the task's.
        errors: (n, o) what the nominal model leaves of them.
        length: rows are padded to this many, so that one program serves every fold.
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
    return Score(cross / size, square / size**2, seed_cross / size, seed_square / size**2)


@jax.jit
def _moments(
    history: Params, inputs: jax.Array, errors: jax.Array, share: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    def of_epoch(params: Params) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        outputs = jax.vmap(partial(predict, inputs=inputs))(params)  # (seed, n, o)
        mean = outputs.mean(axis=0)
        seeds = ((share * errors)[None] * outputs).sum(1), (share[None] * outputs**2).sum(1)
        return (share * errors * mean).sum(0), (share * mean**2).sum(0), *seeds

    by_epoch = jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), history)
    cross, square, seed_cross, seed_square = jax.lax.map(of_epoch, by_epoch)
    return cross, square, jnp.swapaxes(seed_cross, 0, 1), jnp.swapaxes(seed_square, 0, 1)


def choose(
    axes: tuple[str, ...], candidates: dict[bool, list[Score]], config: ResidualConfig
) -> list[Choice]:
    """Choose for every axis of a network.

    Args:
        axes: the network's.
        candidates: scores of every held-out fold, with mirror images and without.
        config: caution and the least gain.
    """
    choices = []
    for column, axis in enumerate(axes):
        options = [
            _best(axis, column, mirror, scores, config) for mirror, scores in candidates.items()
        ]
        choices.append(min(options, key=lambda option: option[0])[1])
    return choices


def refuse_all(axes: tuple[str, ...], reason: str) -> list[Choice]:
    """Every axis refused, where nothing is left to validate on."""
    return [Choice(axis, False, 0, 0.0, (), 0.0, 0.0, 0.0, reason) for axis in axes]


def _ratio(cross: np.ndarray, square: np.ndarray, scale: np.ndarray | float) -> np.ndarray:
    return np.sqrt(np.maximum(1.0 - 2.0 * scale * cross + scale**2 * square, 0.0))


def _best(
    axis: str, column: int, mirror: bool, scores: list[Score], config: ResidualConfig
) -> tuple[float, Choice]:
    """The best epoch and scale of one candidate, and its objective."""
    cross = np.stack([score.cross[:, column] for score in scores])  # (fold, epoch)
    square = np.stack([score.square[:, column] for score in scores])
    ratios = _ratio(cross[..., None], square[..., None], SCALES)  # (fold, epoch, scale)
    harm = np.maximum(ratios.max(axis=0) - 1.0, 0.0)
    objective = ratios.mean(axis=0) + config.caution * harm
    # When to stop is smoothed over neighbouring epochs: the minimum of a noisy curve flatters.
    smooth = np.stack(
        [np.convolve(np.pad(o, 2, "edge"), np.ones(5) / 5, "valid") for o in objective.T], axis=1
    )
    epoch, place = np.unravel_index(int(smooth.argmin()), smooth.shape)
    scale = float(SCALES[place])
    gains = 1.0 - ratios[:, epoch, place]
    seed_cross = np.stack([score.seed_cross[:, epoch, column] for score in scores])
    seed_square = np.stack([score.seed_square[:, epoch, column] for score in scores])
    seed_gains = 1.0 - _ratio(seed_cross, seed_square, scale).mean(axis=0)
    choice = Choice(
        axis=axis,
        mirror=mirror,
        epoch=int(epoch),
        scale=scale,
        gains=tuple(float(gain) for gain in gains),
        gain=float(gains.mean()),
        seed_spread=float(seed_gains.std(ddof=1)) if len(seed_gains) > 1 else 0.0,
        agreement=float((square[:, epoch] / np.maximum(seed_square.mean(1), 1e-30)).mean()),
        refused=None,
    )
    return float(smooth[epoch, place]), _refuse(choice, config)


def _refuse(choice: Choice, config: ResidualConfig) -> Choice:
    """The choice with scale zero and a reason, if it does not clearly beat the nominal model."""
    reason = None
    if choice.scale == 0.0 or choice.gain <= 0.0:
        reason = "no better than the nominal model on held-out data"
    elif choice.gain < config.min_gain:
        reason = f"a gain of {100 * choice.gain:.1f}% on held-out data is too small to trust"
    elif choice.gain < choice.seed_spread:
        reason = (
            f"a gain of {100 * choice.gain:.1f}% on held-out data is within the spread of "
            f"{100 * choice.seed_spread:.1f}% between seeds"
        )
    if reason is None:
        return choice
    return Choice(**{**choice.__dict__, "scale": 0.0, "refused": reason})
