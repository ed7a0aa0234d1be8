"""Distillation of an ensemble to one network of the residual file's size.

The file holds one small network, which a simulation evaluates often. It is trained on the mean
output of the ensemble, after early stopping and shrinkage, which is without noise and defined for
any input. Beyond the range of the logs the target is the output at the nearest input within it, so
that the network does not extrapolate a slope.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from quadjax.core import mlp
from quadjax.core.mlp import Layers
from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.nominal import evaluate
from quadjax.fitting.selection import Selection
from quadjax.fitting.tasks import ResidualNetwork, Task, mirrored
from quadjax.fitting.train import Rows, initial_layers, mean_output, minimize, padded

BATCH = 256


@dataclass(frozen=True)
class Ensemble:
    """The selected ensemble of one network: per axis its task, layers and scale."""

    network: ResidualNetwork
    choices: list[Selection]
    tasks: list[Task]  # one per axis
    layers: list[Layers]  # one per axis, every leaf (seed, ..)

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """Outputs (n, o), SI, of inputs (n, i) in the units of the file."""
        outputs = np.zeros((len(inputs), len(self.choices)))
        parts = zip(self.choices, self.tasks, self.layers, strict=True)
        for column, (choice, task, layers) in enumerate(parts):
            if choice.scale > 0.0:
                within = np.clip(inputs, task.low, task.high)
                scaled = jnp.asarray((within - task.center) / task.scale, jnp.float32)
                mean = np.asarray(mean_output(layers, scaled), np.float64)[:, column]
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


def distill(
    ensembles: list[Ensemble], config: ResidualConfig, seed: int
) -> list[tuple[Layers, np.ndarray]]:
    """Train one network per ensemble, all at once.

    Returns:
        For each, its layers in the units of the file, and the R^2 (o,) of its outputs with respect
        to the ensemble's on the logs (1 for a rejected axis).
    """
    network, random = ensembles[0].network, np.random.default_rng(seed)
    datasets = [_dataset(ensemble, config.margin, random) for ensemble in ensembles]
    length = min(len(rows["inputs"]) for rows in datasets)
    picks = [random.permutation(len(rows["inputs"]))[:length] for rows in datasets]
    fill = np.arange(padded(length)) % length
    rows = {
        name: jnp.asarray(
            np.stack([d[name][p[fill]] for d, p in zip(datasets, picks, strict=True)]), jnp.float32
        )
        for name in datasets[0]
    }
    key = jax.random.key(seed)
    layers = _train(network.hidden(config), config.distill_epochs, rows, length, key)
    return [
        _in_file_units(ensemble, jax.tree.map(lambda x, i=i: np.asarray(x[i], np.float64), layers))
        for i, ensemble in enumerate(ensembles)
    ]


def _dataset(
    ensemble: Ensemble, margin: float, random: np.random.Generator
) -> dict[str, np.ndarray]:
    """Inputs, targets and weights: of the logs, and stretched beyond their range."""
    task, inputs, weights = ensemble.tasks[0], ensemble.logged, ensemble.tasks[0].weights
    if any(choice.mirror and choice.scale > 0.0 for choice in ensemble.choices):
        inputs = np.concatenate([inputs, mirrored(ensemble.network, inputs)])
        weights = np.concatenate([weights, weights])
    middle = 0.5 * (task.low + task.high)
    stretch = 1.0 + margin * random.uniform(size=(len(inputs), 1))
    noise = 0.1 * task.scale * random.normal(size=inputs.shape)
    inputs = np.concatenate([inputs, middle + stretch * (inputs - middle) + noise])
    return {
        "inputs": (inputs - task.center) / task.scale,
        "targets": ensemble(inputs) / ensemble.output_scale,
        "weights": np.concatenate([weights, weights]),
    }


@partial(jax.jit, static_argnames=("hidden", "epochs"))
def _train(hidden: int, epochs: int, rows: Rows, count: jax.Array | int, key: jax.Array) -> Layers:
    """Final layers, leaves (ensemble, ..), of rows (ensemble, n, ..), ``count`` without padding."""
    length = rows["inputs"].shape[1]
    batch = min(BATCH, length)
    schedule = optax.cosine_decay_schedule(1e-2, epochs * -(-length // batch))

    def loss(layers: Layers, part: Rows, key: jax.Array) -> jax.Array:
        return (part["weights"] * (mlp.apply(layers, part["inputs"]) - part["targets"]) ** 2).mean()

    def one(rows: Rows) -> Layers:
        start = initial_layers(key, rows["inputs"].shape[-1], hidden, rows["targets"].shape[-1])
        keys = jax.random.split(key, epochs)
        history = minimize(loss, start, schedule, rows, count, batch, keys)
        return jax.tree.map(lambda leaf: leaf[-1], history)

    return jax.vmap(one)(rows)


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
