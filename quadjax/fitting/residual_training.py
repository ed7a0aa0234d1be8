"""Training of one residual network: minibatches, Adam, L2 and mirror images, in one program."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from quadjax.core.mlp import MLP, Layers, to_layers
from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.nominal import AXES
from quadjax.fitting.signals import Rows, concatenated

HIDDEN = 32
SPREAD = 0.5  # largest initial bias of the hidden layer
# Left and right swapped: motors 1 <-> 2 and 3 <-> 4, and vy, p, r, Mx, Mz change sign.
MIRROR_ORDER = np.array([1, 0, 3, 2, 4, 5, 6, 7, 8, 9])
MIRROR_SIGN = np.array([1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
MIRROR_OUTPUT = {"az": 1.0, "Mx": -1.0, "My": 1.0, "Mz": -1.0}


class ResidualNetwork(NamedTuple):
    """One of the two residual networks."""

    name: str
    axes: tuple[str, ...]
    inputs: int

    @property
    def columns(self) -> list[int]:
        """Indices of its axes in ``AXES``."""
        return [AXES.index(axis) for axis in self.axes]

    @property
    def module(self) -> MLP:
        """The network; its output is small at first."""
        return MLP((HIDDEN, len(self.axes)), last_scale=0.01)


NETWORKS = (
    ResidualNetwork("thrust", ("az",), 7),
    ResidualNetwork("moment", ("Mx", "My", "Mz"), 10),
)


class Errors(struct.PyTreeNode, Rows):
    """What a network has to predict."""

    inputs: np.ndarray  # (n, i) in the units of a residual file
    errors: np.ndarray  # (n, o) measured minus nominal, m/s^2 or N m
    fold: np.ndarray  # (n,) of the row; each counts the same


def mirrored(inputs: np.ndarray) -> np.ndarray:
    """Inputs (n, i) of the mirrored flight."""
    count = inputs.shape[1]
    return inputs[:, MIRROR_ORDER[:count]] * MIRROR_SIGN[:count]


def with_mirror_images(network: ResidualNetwork, rows: Errors) -> Errors:
    """Rows and their mirror images."""
    sign = np.array([MIRROR_OUTPUT[axis] for axis in network.axes])
    image = rows.replace(inputs=mirrored(rows.inputs), errors=rows.errors * sign)
    return concatenated([rows, image])


def train(
    network: ResidualNetwork, config: ResidualConfig, rows: Errors, epoch_rows: int, seed: int
) -> Layers:
    """Train a network.

    Args:
        network: of the two.
        config: of the training.
        rows: to train on.
        epoch_rows: number of rows in an epoch; fewer rows than this are repeated, so that one
            compiled program serves all folds.
        seed: of the initial parameters and of the minibatches.

    Returns:
        The layers after each epoch, in the units of a residual file: leaves (epoch, ..).
    """
    if config.mirror:
        rows, epoch_rows = with_mirror_images(network, rows), 2 * epoch_rows
    center, scale = rows.inputs.mean(axis=0), np.maximum(rows.inputs.std(axis=0), 1e-6)
    size = np.maximum(np.sqrt((rows.errors**2).mean(axis=0)), 1e-12)
    parts = (rows.inputs - center) / scale, rows.errors / size, _weights(rows)
    index = np.resize(np.random.default_rng(seed).permutation(len(rows.fold)), epoch_rows)
    batch = tuple(jnp.asarray(part[index], jnp.float32) for part in parts)
    trained = _train(network, config, batch, jax.random.key(seed))
    (kernel, bias), (last, last_bias) = (map(np.float64, layer) for layer in trained)
    kernel = kernel / scale[:, None]
    layers = (kernel, bias - center @ kernel), (last * size, last_bias * size)
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), layers)


def _weights(rows: Errors) -> np.ndarray:
    """Weights (n, o) of the squared errors that give each fold the same nominal error."""
    weights = np.empty_like(rows.errors)
    for number in np.unique(rows.fold):
        here = rows.fold == number
        weights[here] = 1.0 / np.maximum((rows.errors[here] ** 2).mean(axis=0), 1e-24)
    return weights / weights.mean(axis=0)


Batch = tuple[jax.Array, ...]  # standardized inputs and errors, and weights (n, ..)


@partial(jax.jit, static_argnames=("network", "config"))
def _train(network: ResidualNetwork, config: ResidualConfig, rows: Batch, key: jax.Array) -> Layers:
    optimizer = optax.adam(config.learning_rate)
    count = len(rows[0])
    batch = min(config.batch_size, count)
    steps = count // batch

    def loss(params: Any, part: Batch, key: jax.Array) -> jax.Array:
        inputs, targets, weights = part
        inputs = inputs + config.input_noise * jax.random.normal(key, inputs.shape)
        outputs: Any = network.module.apply({"params": params}, inputs)
        decay = sum((layer["kernel"] ** 2).sum() for layer in params.values())
        return (weights * (outputs - targets) ** 2).mean() + config.weight_decay * decay

    Carry = tuple[Any, optax.OptState]

    def step(carry: Carry, batch: tuple[jax.Array, jax.Array]) -> tuple[Carry, None]:
        (params, state), (index, key) = carry, batch
        gradient = jax.grad(loss)(params, tuple(values[index] for values in rows), key)
        updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(params, updates), state), None

    def epoch(carry: Carry, key: jax.Array) -> tuple[Carry, Any]:
        of_order, of_steps = jax.random.split(key)
        order = jax.random.permutation(of_order, count)[: steps * batch].reshape(steps, batch)
        carry, _ = jax.lax.scan(step, carry, (order, jax.random.split(of_steps, steps)))
        return carry, carry[0]

    of_start, of_epochs = jax.random.split(key)
    params = _initial(network, of_start)
    start = (params, optimizer.init(params))
    return to_layers(jax.lax.scan(epoch, start, jax.random.split(of_epochs, config.epochs))[1])


def _initial(network: ResidualNetwork, key: jax.Array) -> dict[str, Any]:
    """Parameters of a hidden layer whose kinks are spread over standardized inputs."""
    of_network, of_kinks = jax.random.split(key)
    params = network.module.init(of_network, jnp.zeros(network.inputs))["params"]
    bias = jax.random.uniform(of_kinks, (HIDDEN,), minval=-SPREAD, maxval=SPREAD)
    return {**params, "Dense_0": {**params["Dense_0"], "bias": bias}}
