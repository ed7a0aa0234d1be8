"""Fit of the residual networks: training, selection, distillation.

With folds ``0 .. K-1``, one network is trained without each fold, to validate on it, and one on all
of them, to use. To evaluate the whole procedure, selection included, on a flight that it has not
seen, everything is repeated without that flight: a training without a *pair* of folds serves both
members of the pair. For four flights, eleven trainings per candidate and seed cover the fit and its
leave-one-flight-out test; all run as one compiled program.

For each axis the folds choose mirroring, the number of epochs and the scale ``s`` in [0, 1] of the
ensemble's mean. With ``ratio_u(s)`` the root mean square error on held-out fold ``u`` of nominal
plus ``s`` times the mean, relative to nominal alone, they minimize::

    mean_u ratio_u(s) + max(0, max_u ratio_u(s) - 1)

so the worst fold counts twice where the residual increases its error, and no fold's error may
increase by more than ``residual.max_harm``. The gain ``1 - mean_u ratio_u`` of the choice must
exceed ``MIN_GAIN`` and, with two or more seeds, its standard deviation between the seeds.
Otherwise the axis is rejected and its output is zero.

The residual file holds one small network, which a simulation evaluates often. It is trained on the
mean output of the ensemble, after early stopping and shrinkage, which is without noise and defined
for any input. Beyond the range of the logs the target is the output at the nearest input within it,
so that the network does not extrapolate a slope.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import mlp
from quadjax.core.mlp import Layers
from quadjax.fitting.axes import nominal_error
from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.nominal import Constants, evaluate, file_inputs
from quadjax.fitting.residual_training import (
    NETWORKS,
    ResidualNetwork,
    Task,
    Training,
    make_task,
    mirrored,
    padded,
    train,
)
from quadjax.fitting.samples import ALL, LeftOut, Samples, Split
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import Residual

SAMPLE_RATE = 50.0  # Hz, of the rows that networks are trained on
MARGIN = 0.5  # range beyond the logs where the output stays constant
SCALES = np.linspace(0.0, 1.0, 21)
MIN_GAIN = 0.01  # least relative gain on held-out data
SMOOTHED = 5  # epochs: the minimum of a noisy curve is biased
ENSEMBLE = 0  # index of the mean of all seeds among the members


@dataclass(frozen=True)
class Choice:
    """The selected residual of one axis."""

    axis: str  # of ``AXES``
    mirror: bool = False  # whether it is trained on mirror images
    epoch: int = 0  # index into the training's history
    scale: float = 0.0  # of the output; zero if rejected
    gains: tuple[float, ...] = ()  # of each held-out fold, before any rejection
    gain: float = 0.0  # their mean
    seed_spread: float = 0.0  # standard deviation of the mean gain over seeds; nan for one seed
    agreement: float = 0.0  # mean square of the mean output over mean square output
    rejected: str | None = None  # the reason; None if accepted
    distilled: float = 1.0  # R^2 of the file's network to the ensemble; 1 if rejected


@dataclass(frozen=True)
class ResidualFit:
    """The residual of one complete fit, and its choices by axis."""

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


def fit_residuals(
    samples: Samples,
    split: Split,
    base: MotorConstants,
    constants: Callable[[LeftOut], Constants],
    config: ResidualConfig,
    seed: int,
    report: Callable[[str], None] = lambda line: None,
) -> dict[LeftOut, ResidualFit]:
    """Fit both networks on all folds and once more without the folds of every complete fit.

    Args:
        samples: every row, at the logs' rate.
        split: its folds.
        base: with the rpm range of the residual file.
        constants: nominal model of the rows without some folds.
        config: of the training.
        seed: of everything random.
        report: called with the progress.
    """
    every = slice(None, None, max(1, int(round(samples.sample_rate / SAMPLE_RATE))))
    rows, thinned = samples[every], replace(split, fold=split.fold[every])
    folds, complete = split.inner(ALL), split.complete()
    left_outs = [ALL, *(frozenset({fold}) for fold in folds)]
    if len(complete) > 1 and len(folds) > 2:
        left_outs += [frozenset(pair) for pair in combinations(folds, 2)]
    models = {left_out: constants(left_out) for left_out in left_outs}
    inputs = file_inputs(rows.motion, (float(base.rpm_min), float(base.rpm_max)))
    errors = {left_out: nominal_error(rows, model) for left_out, model in models.items()}
    layers: dict[LeftOut, list[Layers]] = {left_out: [] for left_out in complete}
    choices: dict[LeftOut, dict[str, Choice]] = {left_out: {} for left_out in complete}
    for network in NETWORKS:
        report(f"training the {network.name} network, {len(models)} times {config.seeds} seeds")
        targets = {left_out: error[:, network.columns] for left_out, error in errors.items()}
        trained = _Trained(network, inputs[:, : network.inputs], targets, thinned, config, seed)
        ensembles = [trained.select(left_out) for left_out in complete]
        report(f"distilling the {network.name} network")
        results = _distill(network, ensembles, 2 * config.epochs, seed)
        for left_out, ensemble, (nets, grades) in zip(complete, ensembles, results, strict=True):
            layers[left_out].append(nets)
            for choice, grade in zip(ensemble.choices, grades, strict=True):
                choices[left_out][choice.axis] = replace(choice, distilled=float(grade))
    return {key: ResidualFit(_residual(base, layers[key]), choices[key]) for key in complete}


class _Trained:
    """All trainings of one network: without each of several folds, with and without mirroring."""

    def __init__(
        self,
        network: ResidualNetwork,
        inputs: np.ndarray,
        errors: dict[LeftOut, np.ndarray],
        split: Split,
        config: ResidualConfig,
        seed: int,
    ) -> None:
        self.network, self.inputs, self.errors, self.split = network, inputs, errors, split
        self.max_harm = config.max_harm
        self.mirrors = {"auto": (True, False), "on": (True,), "off": (False,)}[config.mirror]
        self.tasks: dict[tuple[LeftOut, bool], Task] = {}
        for mirror, (left_out, error) in product(self.mirrors, errors.items()):
            used = split.learned(left_out)
            rows = inputs[used], error[used], split.fold[used]
            self.tasks[left_out, mirror] = make_task(*rows, mirror)
        keys = jax.vmap(jax.random.split)(jax.random.split(jax.random.key(seed), config.seeds))
        history = train(network, Training(config.epochs), list(self.tasks.values()), keys)
        history = jax.tree.map(np.asarray, history)
        # Every leaf (seed, epoch, ..).
        self.layers: dict[tuple[LeftOut, bool], Layers] = {
            key: jax.tree.map(lambda leaf, i=i: leaf[i], history)
            for i, key in enumerate(self.tasks)
        }

    def scores(self, left_out: LeftOut, mirror: bool, held_out: int) -> np.ndarray:
        """Second moments of a training on a held-out fold, relative to the nominal square error.

        Returns:
            (epoch, member, o, 2): mean error times output, and mean square output. The first member
            is the mean of all seeds, the others are the seeds.
        """
        task, rows = self.tasks[left_out, mirror], self.split.fold == held_out
        inputs = (self.inputs[rows] - task.center) / task.scale
        errors = self.errors[left_out][rows] / task.error_scale
        longest = int(np.bincount(self.split.fold[self.split.fold >= 0]).max())
        padding = ((0, padded(longest) - len(inputs)), (0, 0))
        size = np.sqrt((errors**2).mean(axis=0))
        moments = _moments(
            self.layers[left_out, mirror],
            jnp.asarray(np.pad(inputs, padding), jnp.float32),
            jnp.asarray(np.pad(errors / np.maximum(size, 1e-12), padding), jnp.float32),
            jnp.asarray(np.arange(padded(longest)) < len(inputs), jnp.float32)[:, None]
            / len(inputs),
        )
        # Outputs are in the task's units; errors were divided by this fold's size.
        return np.asarray(moments, np.float64) / np.stack([size, size**2], axis=-1)

    def select(self, left_out: LeftOut) -> "Ensemble":
        """The ensemble that is best on the remaining folds."""
        inner = self.split.inner(left_out)
        reason = "no second flight to validate on"
        choices = [Choice(axis, self.mirrors[0], rejected=reason) for axis in self.network.axes]
        if len(inner) > 1:
            scores = {
                mirror: np.stack([self.scores(left_out | {k}, mirror, k) for k in inner])
                for mirror in self.mirrors
            }
            choices = select(self.network.axes, scores, self.max_harm)
        layers = [
            jax.tree.map(lambda leaf, e=c.epoch: leaf[:, e], self.layers[left_out, c.mirror])
            for c in choices
        ]
        return Ensemble(choices, [self.tasks[left_out, c.mirror] for c in choices], layers)


@jax.jit
def _moments(history: Layers, inputs: jax.Array, errors: jax.Array, weight: jax.Array) -> jax.Array:
    def of_epoch(layers: Layers) -> jax.Array:
        outputs = jax.vmap(lambda x: mlp.apply(mlp.to_params(x), inputs))(layers)  # (seed, n, o)
        members = jnp.concatenate([outputs.mean(axis=0)[None], outputs])
        cross, square = (weight * errors * members).sum(1), (weight * members**2).sum(1)
        return jnp.stack([cross, square], axis=-1)

    return jax.lax.map(of_epoch, jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), history))


def select(
    axes: Sequence[str], candidates: dict[bool, np.ndarray], max_harm: float
) -> list[Choice]:
    """Select the residual of every axis of a network; rejected candidates only if all are.

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
    curves = np.pad(ratios.mean(axis=0) + harm, ((reach, reach), (0, 0)), "edge").T
    smooth = np.stack([np.convolve(curve, window, "valid") for curve in curves], axis=1)
    smooth = np.where(harm > max_harm, np.inf, smooth)
    epoch, place = np.unravel_index(int(smooth.argmin()), smooth.shape)
    scale, gains = float(SCALES[place]), 1.0 - ratios[:, epoch, place]
    seeds = scores[:, epoch, ENSEMBLE + 1 :]  # (fold, seed, 2)
    seed_gains = 1.0 - _ratio(seeds, scale).mean(axis=0)
    spread = float(seed_gains.std(ddof=1)) if len(seed_gains) > 1 else float("nan")
    square = scores[:, epoch, ENSEMBLE, 1]
    rejected = _rejected(scale, float(gains.mean()), spread)
    choice = Choice(
        axis=axis,
        mirror=mirror,
        epoch=int(epoch),
        scale=0.0 if rejected else scale,
        gains=tuple(float(gain) for gain in gains),
        gain=float(gains.mean()),
        seed_spread=spread,
        agreement=float((square / np.maximum(seeds[..., 1].mean(1), 1e-30)).mean()),
        rejected=rejected,
    )
    return float(smooth[epoch, place]), choice


def _rejected(scale: float, gain: float, seed_spread: float) -> str | None:
    """Why a choice is not clearly better than the nominal model; None if it is."""
    percent = f"a gain of {100 * gain:.1f}% on held-out data"
    if scale == 0.0 or gain <= 0.0:
        return "no better than the nominal model on held-out data"
    if gain < MIN_GAIN:
        return f"{percent} is below {100 * MIN_GAIN:g}%"
    if gain < seed_spread:
        spread = f"its standard deviation between seeds, {100 * seed_spread:.1f}%"
        return f"{percent} is below {spread}"
    return None


@dataclass(frozen=True)
class Ensemble:
    """The selected ensemble of one network: per axis its choice, task and layers (seed, ..)."""

    choices: list[Choice]
    tasks: list[Task]
    layers: list[Layers]

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """Outputs (n, o), SI, of inputs (n, i) in the units of the file."""
        outputs = np.zeros((len(inputs), len(self.choices)))
        parts = zip(self.choices, self.tasks, self.layers, strict=True)
        for column, (choice, task, layers) in enumerate(parts):
            if choice.scale > 0.0:
                within = np.clip(inputs, task.low, task.high)
                scaled = jnp.asarray((within - task.center) / task.scale, jnp.float32)
                mean = np.asarray(_mean_output(layers, scaled), np.float64)[:, column]
                outputs[:, column] = choice.scale * task.error_scale[column] * mean
        return outputs


@jax.jit
def _mean_output(layers: Layers, inputs: jax.Array) -> jax.Array:
    """Mean output (n, o) of an ensemble of networks, leaves (seed, ..)."""
    return jax.vmap(lambda x: mlp.apply(mlp.to_params(x), inputs))(layers).mean(axis=0)


def _distill(
    network: ResidualNetwork, ensembles: Sequence[Ensemble], epochs: int, seed: int
) -> list[tuple[Layers, np.ndarray]]:
    """Train one network per ensemble, all at once.

    Returns:
        For each, its layers in the units of the file, and the R^2 (o,) of its outputs with respect
        to the ensemble's on the logs (1 for a rejected axis).
    """
    random = np.random.default_rng(seed)
    datasets = [_dataset(ensemble, random) for ensemble in ensembles]
    length = min(len(task.inputs) for task in datasets)
    tasks = []
    for task in datasets:
        rows = random.permutation(len(task.inputs))[:length]
        inputs, targets, weights = (x[rows] for x in (task.inputs, task.targets, task.weights))
        tasks.append(task._replace(inputs=inputs, targets=targets, weights=weights))
    key = jax.random.key(seed)
    how = Training(epochs, batch=256, learning_rate=1e-2, cosine=True, decay=0.0, average=0.0)
    history = train(network, how, tasks, jnp.stack([key, key])[None])
    results = []
    for index, (ensemble, task) in enumerate(zip(ensembles, tasks, strict=True)):
        layers = jax.tree.map(lambda x, i=index: np.asarray(x[i, 0, -1], np.float64), history)
        results.append(_in_file_units(ensemble, task, layers))
    return results


def _dataset(ensemble: Ensemble, random: np.random.Generator) -> Task:
    """The outputs of an ensemble at the inputs of the logs, and stretched beyond their range."""
    task = ensemble.tasks[0]
    logged = task.inputs * task.scale + task.center
    size = np.maximum(np.sqrt((ensemble(logged) ** 2).mean(axis=0)), 1e-9)
    inputs, weights = logged, task.weights
    if any(choice.mirror and choice.scale > 0.0 for choice in ensemble.choices):
        inputs = np.concatenate([inputs, mirrored(inputs)])
        weights = np.concatenate([weights, weights])
    middle = 0.5 * (task.low + task.high)
    stretch = 1.0 + MARGIN * random.uniform(size=(len(inputs), 1))
    noise = 0.1 * task.scale * random.normal(size=inputs.shape)
    inputs = np.concatenate([inputs, middle + stretch * (inputs - middle) + noise])
    return task._replace(
        inputs=(inputs - task.center) / task.scale,
        targets=ensemble(inputs) / size,
        weights=np.concatenate([weights, weights]),
        mirror=False,
        error_scale=size,
    )


def _in_file_units(ensemble: Ensemble, task: Task, layers: Layers) -> tuple[Layers, np.ndarray]:
    """Fold the scaling into the layers, zero rejected axes, and compute the R^2."""
    used = np.array([choice.scale > 0.0 for choice in ensemble.choices])
    (first, first_bias), (last, last_bias) = layers
    kernel = first / task.scale[:, None]
    size = np.where(used, task.error_scale, 0.0)
    hidden = kernel, first_bias - task.center @ kernel
    scaled = hidden, (last * size, last_bias * size)
    logged = ensemble.tasks[0].inputs * task.scale + task.center
    wanted = ensemble(logged)
    error = ((evaluate(scaled, logged) - wanted) ** 2).mean(axis=0)
    grade = np.where(used, 1.0 - error / np.maximum(wanted.var(axis=0), 1e-30), 1.0)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), scaled), grade
