"""Fit of the residual networks: one for the thrust, one for the moments.

A network is trained once without each fold and evaluated on it after each epoch, then once on all
of them. The folds left out choose the number of epochs, and for each axis the scale ``s`` in [0, 1]
of the output. With ``ratio_u(s)`` the root mean square error on fold ``u`` of nominal plus ``s``
times the output, relative to nominal alone, the choice minimizes the sum over axes of::

    mean_u ratio_u(s) + max(0, max_u ratio_u(s) - 1)

so the worst fold counts twice where the residual increases its error, and no fold's error may
increase by more than ``residual.max_harm``. An axis with a gain ``1 - mean_u ratio_u`` below
``MIN_GAIN`` is rejected: its output is zero.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import uniform_filter1d

from quadjax.core import mlp
from quadjax.core.mlp import Layers
from quadjax.fitting.axes import nominal_error
from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.nominal import Constants, file_inputs
from quadjax.fitting.residual_training import NETWORKS, Errors, ResidualNetwork, train
from quadjax.fitting.samples import Folds, Samples, Split
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import Residual

SAMPLE_RATE_HZ = 50.0  # of the rows that networks are trained on
SCALES = np.linspace(0.0, 1.0, 21)
MIN_GAIN = 0.01  # least relative gain on held-out data
SMOOTHED = 5  # epochs: the minimum of a noisy curve is biased


@dataclass(frozen=True)
class Choice:
    """What held-out folds choose for one axis."""

    epochs: int  # of the training
    scale: float  # of the output; zero if rejected
    gains: tuple[float, ...] = ()  # of each held-out fold, before any rejection
    rejected: str | None = None  # the reason; None if accepted

    @property
    def gain(self) -> float:
        """Mean gain of the held-out folds; nan without any."""
        return float(np.mean(self.gains)) if self.gains else float("nan")


@dataclass(frozen=True)
class ResidualFit:
    """A residual, and the choices by axis; none of one that is not fitted."""

    residual: Residual
    choices: dict[str, Choice]


def zero_residual(base: MotorConstants) -> ResidualFit:
    """A residual with output zero."""
    networks: list[Layers] = []
    for network in NETWORKS:
        count = len(network.axes)
        hidden = jnp.zeros((network.inputs, 1)), jnp.zeros(1)
        networks.append((hidden, (jnp.zeros((1, count)), jnp.zeros(count))))
    return ResidualFit(_residual(base, networks), {})


def _residual(base: MotorConstants, networks: Sequence[Layers]) -> Residual:
    thrust, moment = networks
    rpm_min, rpm_max, sign = (jnp.float32(x) for x in (base.rpm_min, base.rpm_max, 1.0))
    return Residual(mlp.to_params(thrust), mlp.to_params(moment), rpm_min, rpm_max, sign)


class ResidualFits:
    """Both networks, fitted to some folds of the rows; each training is done once."""

    def __init__(
        self,
        samples: Samples,
        split: Split,
        base: MotorConstants,
        constants: Callable[[Folds], Constants],
        config: ResidualConfig,
        seed: int,
    ) -> None:
        """Prepare the rows.

        Args:
            samples: every row, at the logs' rate.
            split: its folds.
            base: with the rpm range of the residual file.
            constants: the nominal model that is fitted to some folds.
            config: of the training.
            seed: of everything random.
        """
        every = slice(None, None, max(1, int(round(samples.sample_rate / SAMPLE_RATE_HZ))))
        self._rows, self._fold = samples[every], split.fold[every]
        ends = float(base.rpm_min), float(base.rpm_max)
        self._inputs = file_inputs(self._rows.motion, ends)
        self._base, self._constants, self._config, self._seed = base, constants, config, seed
        self._errors: dict[Folds, np.ndarray] = {}
        self._trained: dict[tuple[ResidualNetwork, Folds], Layers] = {}

    def __call__(self, folds: Folds) -> ResidualFit:
        """The residual and all choices, of some folds alone."""
        networks: list[Layers] = []
        choices: dict[str, Choice] = {}
        for network in NETWORKS:
            found = self._choose(network, folds)
            choices |= dict(zip(network.axes, found, strict=True))
            last, scale = found[0].epochs - 1, jnp.array([choice.scale for choice in found])
            layers = jax.tree.map(lambda x, last=last: x[last], self._train(network, folds))
            hidden, (kernel, bias) = layers
            networks.append((hidden, (scale * kernel, scale * bias)))
        return ResidualFit(_residual(self._base, networks), choices)

    def _choose(self, network: ResidualNetwork, folds: Folds) -> list[Choice]:
        """The choice of each axis."""
        count, last = len(network.axes), self._config.epochs
        if len(folds) > 1:
            scores = [self._score(network, folds - {fold}, fold) for fold in sorted(folds)]
            return select(np.stack(scores), self._config)
        if self._config.select:
            return [Choice(last, 0.0, (), "no second flight to validate on")] * count
        return [Choice(last, 1.0)] * count

    def _part(self, network: ResidualNetwork, folds: Folds, rows: np.ndarray) -> Errors:
        """Rows, with errors of the nominal model that is fitted to some folds."""
        if folds not in self._errors:
            self._errors[folds] = nominal_error(self._rows, self._constants(folds))
        inputs, errors = self._inputs[:, : network.inputs], self._errors[folds][:, network.columns]
        return Errors(inputs, errors, self._fold)[rows]

    def _train(self, network: ResidualNetwork, folds: Folds) -> Layers:
        """The layers after each epoch of a training on some folds, leaves (epoch, ..)."""
        if (network, folds) not in self._trained:
            rows = self._part(network, folds, np.isin(self._fold, list(folds)))
            epoch = int((self._fold >= 0).sum())
            trained = train(network, self._config, rows, epoch, self._seed)
            self._trained[network, folds] = trained
        return self._trained[network, folds]

    def _score(self, network: ResidualNetwork, folds: Folds, held_out: int) -> np.ndarray:
        """Products (epoch, o, 2) on a fold, by a training on other folds.

        They are the mean of error times output and the mean squared output, both divided by the
        mean squared error.
        """
        part = self._part(network, folds, self._fold == held_out)
        outputs = np.float64(_outputs(self._train(network, folds), jnp.float32(part.inputs)))
        products = (part.errors * outputs).mean(axis=1), (outputs**2).mean(axis=1)
        return np.stack(products, axis=-1) / (part.errors**2).mean(axis=0)[:, None]


@jax.jit
def _outputs(history: Layers, inputs: jax.Array) -> jax.Array:
    """Outputs (epoch, n, o) of layers with leaves (epoch, ..)."""
    return jax.lax.map(lambda layers: mlp.apply(mlp.to_params(layers), inputs), history)


def select(scores: np.ndarray, config: ResidualConfig) -> list[Choice]:
    """The number of epochs, and the scale of each axis.

    Args:
        scores: products (fold, epoch, o, 2) on held-out folds.
        config: of the training; without ``select``, all epochs and the scale 1 are taken.
    """
    cross, square = scores[..., 0, None], scores[..., 1, None]
    ratios = np.sqrt(np.maximum(1.0 - 2.0 * SCALES * cross + SCALES**2 * square, 0.0))
    harm = np.maximum(ratios.max(axis=0) - 1.0, 0.0)  # (epoch, o, scale)
    cost = uniform_filter1d(ratios.mean(axis=0) + harm, SMOOTHED, axis=0, mode="nearest")
    cost = np.where(harm > config.max_harm, np.inf, cost)
    epoch = int(cost.min(axis=2).sum(axis=1).argmin()) if config.select else len(cost) - 1
    choices = []
    for axis in range(cost.shape[1]):
        place = int(cost[epoch, axis].argmin()) if config.select else -1
        gains = tuple(float(x) for x in 1.0 - ratios[:, epoch, axis, place])
        choice = Choice(epoch + 1, float(SCALES[place]), gains)
        if config.select and choice.gain < MIN_GAIN:
            reason = f"a gain of {100 * choice.gain:.1f}% on held-out data is below "
            choice = Choice(epoch + 1, 0.0, gains, f"{reason}{100 * MIN_GAIN:g}%")
        choices.append(choice)
    return choices
