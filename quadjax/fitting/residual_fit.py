"""Fit of the residual networks: training, selection, distillation.

With folds ``0 .. K-1``, one network is trained without each fold, to validate on it, and one on all
of them, to use. To evaluate the whole procedure, selection included, on a flight that it has not
seen, everything is repeated without that flight: a training without a *pair* of folds serves both
members of the pair. For four flights, eleven trainings per candidate and seed cover the fit and its
leave-one-flight-out test; all run as one compiled program.

The residual file holds one small network, which a simulation evaluates often. It is trained on the
mean output of the ensemble, after early stopping and shrinkage, which is without noise and defined
for any input. Beyond the range of the logs the target is the output at the nearest input within it,
so that the network does not extrapolate a slope.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import mlp
from quadjax.core.mlp import Layers
from quadjax.fitting.axes import nominal_error
from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.nominal import Constants, evaluate, file_inputs
from quadjax.fitting.prepare import Samples, thin
from quadjax.fitting.residual_training import (
    NETWORKS,
    ResidualNetwork,
    Tasks,
    Training,
    make_tasks,
    mirrored,
    padded,
    train,
    train_rows,
)
from quadjax.fitting.selection import Choice, fold_scores, select
from quadjax.fitting.split import ALL, LeftOut, Split
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import Residual

SAMPLE_RATE = 50.0  # Hz, of the rows that networks are trained on
MARGIN = 0.5  # range beyond the logs where the output stays constant
DISTILLATION = {"batch": 256, "learning_rate": 1e-2, "cosine": True, "decay": 0.0, "average": 0.0}


@dataclass(frozen=True)
class ResidualFit:
    """The residual of one complete fit."""

    residual: Residual
    choices: dict[str, Choice]  # by axis
    distilled: dict[str, float]  # by axis: R^2 of the file's network to the ensemble


def zero_residual(base: MotorConstants) -> ResidualFit:
    """A residual with output zero."""
    thrust, moment = (
        (
            (np.zeros((network.inputs, 1)), np.zeros(1)),
            (np.zeros((1, len(network.axes))), np.zeros(len(network.axes))),
        )
        for network in NETWORKS.values()
    )
    return ResidualFit(_residual(base, thrust, moment), {}, {})


def fit_residuals(
    samples: Samples,
    split: Split,
    base: MotorConstants,
    constants: Callable[[LeftOut], Constants],
    complete: Sequence[LeftOut],
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
        complete: folds that are left out of each complete fit, nested ones with one fold.
        config: of the training.
        seed: of everything random.
        report: called with the progress.
    """
    every = max(1, int(round(samples.sample_rate / SAMPLE_RATE)))
    rows, folds = thin(samples, SAMPLE_RATE), range(split.folds)
    thinned = Split(split.by, split.fold[::every], split.names)
    left_outs = [ALL] + [frozenset({fold}) for fold in folds]
    if len(complete) > 1 and split.folds > 2:
        left_outs += [frozenset(pair) for pair in combinations(folds, 2)]
    models = {left_out: constants(left_out) for left_out in left_outs}
    results: dict[LeftOut, list[tuple[Ensemble, Layers, np.ndarray]]] = {s: [] for s in complete}
    for network in NETWORKS.values():
        report(f"training the {network.name} network, {len(models)} times {config.seeds} seeds")
        trained = _Trained(network, rows, thinned, base, models, config, seed)
        ensembles = [trained.select(left_out) for left_out in complete]
        report(f"distilling the {network.name} network")
        distilled = _distill(network, ensembles, config.distill_epochs, seed)
        for left_out, ensemble, parts in zip(complete, ensembles, distilled, strict=True):
            results[left_out].append((ensemble, *parts))
    return {left_out: _assemble(base, *parts) for left_out, parts in results.items()}


def _assemble(base: MotorConstants, *parts: tuple["Ensemble", Layers, np.ndarray]) -> ResidualFit:
    choices, distilled = {}, {}
    for ensemble, _, grades in parts:
        for choice, grade in zip(ensemble.choices, grades, strict=True):
            choices[choice.axis], distilled[choice.axis] = choice, float(grade)
    (_, thrust, _), (_, moment, _) = parts
    return ResidualFit(_residual(base, thrust, moment), choices, distilled)


def _residual(base: MotorConstants, thrust: Layers, moment: Layers) -> Residual:
    rpm_min, rpm_max, sign = (jnp.float32(x) for x in (base.rpm_min, base.rpm_max, 1.0))
    return Residual(thrust, moment, rpm_min, rpm_max, sign)


class _Trained:
    """All trainings of one network."""

    def __init__(
        self,
        network: ResidualNetwork,
        samples: Samples,
        split: Split,
        base: MotorConstants,
        models: dict[LeftOut, Constants],
        config: ResidualConfig,
        seed: int,
    ) -> None:
        self.network, self.split, self.max_harm = network, split, config.max_harm
        mirrors = {"auto": (True, False), "on": (True,), "off": (False,)}[config.mirror]
        self.mirrors: tuple[bool, ...] = mirrors
        self.index = {
            key: i for i, key in enumerate((s, mirror) for mirror in mirrors for s in models)
        }
        cases = [(split.learned(s), mirror, models[s]) for s, mirror in self.index]
        rpm_range = float(base.rpm_min), float(base.rpm_max)
        self.tasks = make_tasks(network, samples, split.fold, cases, rpm_range)
        self.history = train(network, self.tasks, Training(config.epochs), seed, config.seeds)
        self.inputs = file_inputs(samples.motion, rpm_range)[:, : network.inputs]
        self.errors = {s: nominal_error(samples, c)[:, network.columns] for s, c in models.items()}
        self.longest = padded(int(np.bincount(split.fold[split.fold >= 0]).max()))

    def layers(self, task: int) -> Layers:
        """Layers of one task, every leaf (seed, epoch, ..)."""
        return jax.tree.map(lambda leaf: leaf[task], self.history)

    def scores(self, left_out: LeftOut, mirror: bool, held_out: int) -> np.ndarray:
        """Scores of one task's ensemble on a fold that it was trained without."""
        index, rows = self.index[left_out, mirror], self.split.fold == held_out
        task = self.tasks[index]
        inputs = (self.inputs[rows] - task.center) / task.scale
        errors = self.errors[left_out][rows] / task.error_scale
        return fold_scores(self.layers(index), inputs, errors, self.longest)

    def select(self, left_out: LeftOut) -> "Ensemble":
        """The ensemble that is best on the remaining folds."""
        inner = [fold for fold in range(self.split.folds) if fold not in left_out]
        reason = "no second flight to validate on"
        choices = [Choice(axis, self.mirrors[0], rejected=reason) for axis in self.network.axes]
        if len(inner) > 1:
            candidates = {
                mirror: np.stack([self.scores(left_out | {k}, mirror, k) for k in inner])
                for mirror in self.mirrors
            }
            choices = select(self.network.axes, candidates, self.max_harm)
        indices = [self.index[left_out, choice.mirror] for choice in choices]
        layers = [
            jax.tree.map(lambda leaf, e=choice.epoch: leaf[:, e], self.layers(index))
            for index, choice in zip(indices, choices, strict=True)
        ]
        return Ensemble(choices, [self.tasks[index] for index in indices], layers)


@dataclass(frozen=True)
class Ensemble:
    """The selected ensemble of one network: per axis its choice, task and layers (seed, ..)."""

    choices: list[Choice]
    tasks: list[Tasks]
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

    @property
    def logged(self) -> np.ndarray:
        """The inputs (n, i) of the logs, in the units of the file."""
        return self.tasks[0].inputs * self.tasks[0].scale + self.tasks[0].center

    @property
    def output_scale(self) -> np.ndarray:
        """Root mean square (o,) of the outputs on the logs."""
        return np.maximum(np.sqrt((self(self.logged) ** 2).mean(axis=0)), 1e-9)


@jax.jit
def _mean_output(layers: Layers, inputs: jax.Array) -> jax.Array:
    """Mean output (n, o) of an ensemble of networks, leaves (seed, ..)."""
    return jax.vmap(partial(mlp.apply, inputs=inputs))(layers).mean(axis=0)


def _distill(
    network: ResidualNetwork, ensembles: list[Ensemble], epochs: int, seed: int
) -> list[tuple[Layers, np.ndarray]]:
    """Train one network per ensemble, all at once.

    Returns:
        For each, its layers in the units of the file, and the R^2 (o,) of its outputs with respect
        to the ensemble's on the logs (1 for a rejected axis).
    """
    random = np.random.default_rng(seed)
    datasets = [_dataset(network, ensemble, random) for ensemble in ensembles]
    length = min(len(rows["inputs"]) for rows in datasets)
    picks = [random.permutation(len(rows["inputs"]))[:length] for rows in datasets]
    fill = np.arange(padded(length)) % length
    rows = {
        name: np.stack([data[name][p[fill]] for data, p in zip(datasets, picks, strict=True)])
        for name in datasets[0]
    }
    count, mirror = np.full(len(ensembles), length), np.zeros(len(ensembles), bool)
    key, how = jax.random.key(seed)[None], Training(epochs, **DISTILLATION)
    history = train_rows(network, how, rows, count, mirror, key, key)
    return [
        _in_file_units(
            ensemble, jax.tree.map(lambda x, i=i: np.asarray(x[i, 0, -1], np.float64), history)
        )
        for i, ensemble in enumerate(ensembles)
    ]


def _dataset(
    network: ResidualNetwork, ensemble: Ensemble, random: np.random.Generator
) -> dict[str, np.ndarray]:
    """Inputs, targets and weights: of the logs, and stretched beyond their range."""
    task, inputs = ensemble.tasks[0], ensemble.logged
    weights = task.weights
    if any(choice.mirror and choice.scale > 0.0 for choice in ensemble.choices):
        inputs = np.concatenate([inputs, mirrored(network, inputs)])
        weights = np.concatenate([weights, weights])
    middle = 0.5 * (task.low + task.high)
    stretch = 1.0 + MARGIN * random.uniform(size=(len(inputs), 1))
    noise = 0.1 * task.scale * random.normal(size=inputs.shape)
    inputs = np.concatenate([inputs, middle + stretch * (inputs - middle) + noise])
    return {
        "inputs": (inputs - task.center) / task.scale,
        "targets": ensemble(inputs) / ensemble.output_scale,
        "weights": np.concatenate([weights, weights]),
    }


def _in_file_units(ensemble: Ensemble, layers: Layers) -> tuple[Layers, np.ndarray]:
    """Fold the scaling into the layers, zero rejected axes, and compute the R^2."""
    task = ensemble.tasks[0]
    kept = np.array([choice.scale > 0.0 for choice in ensemble.choices])
    (first, first_bias), last = layers
    kernel = first / task.scale[:, None]
    scaled = (
        (kernel, first_bias - task.center @ kernel),
        tuple(np.where(kept, values * ensemble.output_scale, 0.0) for values in last),
    )
    wanted = ensemble(ensemble.logged)
    error = ((evaluate(scaled, ensemble.logged) - wanted) ** 2).mean(axis=0)
    grade = np.where(kept, 1.0 - error / np.maximum(wanted.var(axis=0), 1e-30), 1.0)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), scaled), grade
