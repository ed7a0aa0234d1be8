"""Training of the residual networks: every training of one network in one compiled program.

A network is trained many times, each time without some folds. Every such *task* has its own nominal
model and scaling, so that it contains no information of the folds left out.
"""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.nn.initializers import he_normal

from quadjax.core import mlp
from quadjax.core.mlp import Layers
from quadjax.fitting.nominal import AXES

PADDING = 512  # numbers of rows are padded to multiples of it, so that fits share programs
HIDDEN = 32
NOISE = 0.1  # of the inputs with mirroring, in standard deviations
# Left and right swapped: motors 1 <-> 2 and 3 <-> 4, and vy, p, r, Mx, Mz change sign.
MIRROR_ORDER = np.array([1, 0, 3, 2, 4, 5, 6, 7, 8, 9])
MIRROR_SIGN = np.array([1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
MIRROR_OUTPUT = {"az": 1.0, "Mx": -1.0, "My": 1.0, "Mz": -1.0}


class Training(NamedTuple):
    """How a network is trained."""

    epochs: int
    batch: int = 128
    learning_rate: float = 3e-3  # of Adam
    cosine: bool = False  # decay of the learning rate to zero
    decay: float = 1e-3  # L2 penalty on the last layer
    average: float = 0.99  # decay of the averaged layers


class ResidualNetwork(NamedTuple):
    """One of the two residual networks."""

    name: str
    axes: tuple[str, ...]
    inputs: int

    @property
    def columns(self) -> list[int]:
        """Indices of its axes in ``AXES``."""
        return [AXES.index(axis) for axis in self.axes]


NETWORKS = (
    ResidualNetwork("thrust", ("az",), 7),
    ResidualNetwork("moment", ("Mx", "My", "Mz"), 10),
)


class Task(NamedTuple):
    """One training, scaled by its own n rows."""

    inputs: np.ndarray  # (n, i) standardized
    targets: np.ndarray  # (n, o) errors of the nominal model, standardized
    weights: np.ndarray  # (n, o) the same total per fold
    mirror: bool  # whether mirror images are used
    center: np.ndarray  # (i,) of the inputs, file units
    scale: np.ndarray  # (i,)
    low: np.ndarray  # (i,) range of the inputs, file units
    high: np.ndarray  # (i,)
    error_scale: np.ndarray  # (o,) root mean square error of the nominal model


def mirrored(inputs: np.ndarray) -> np.ndarray:
    """Inputs (n, i) of the mirrored flight."""
    count = inputs.shape[1]
    return inputs[:, MIRROR_ORDER[:count]] * MIRROR_SIGN[:count]


def padded(count: int) -> int:
    """A number of rows with padding."""
    return -(-count // PADDING) * PADDING


def make_task(inputs: np.ndarray, errors: np.ndarray, fold: np.ndarray, mirror: bool) -> Task:
    """A training on inputs (n, i) in file units, errors (n, o), and the fold (n,) of each row."""
    seen = np.concatenate([inputs, mirrored(inputs)]) if mirror else inputs
    center, scale = seen.mean(axis=0), np.maximum(seen.std(axis=0), 1e-6)
    error_scale = np.maximum(np.sqrt((errors**2).mean(axis=0)), 1e-12)
    weights = np.ones_like(errors)
    for number in np.unique(fold):
        here = fold == number
        weights[here] = error_scale**2 / np.maximum((errors[here] ** 2).mean(axis=0), 1e-24)
    return Task(
        inputs=(inputs - center) / scale,
        targets=errors / error_scale,
        weights=weights / weights.mean(axis=0),
        mirror=mirror,
        center=center,
        scale=scale,
        low=seen.min(axis=0),
        high=seen.max(axis=0),
        error_scale=error_scale,
    )


def train(
    network: ResidualNetwork, how: Training, tasks: Sequence[Task], keys: jax.Array
) -> Layers:
    """Train every task with every seed.

    Args:
        network: of the two.
        how: it is trained.
        tasks: their inputs, targets, weights and mirror.
        keys: (seed, 2) of the first layers, and of the epochs.

    Returns:
        The averaged layers after each epoch: leaves (task, seed, epoch, ..).
    """
    length = padded(max(len(task.inputs) for task in tasks))
    parts = [(task.inputs, task.targets, task.weights) for task in tasks]
    rows = tuple(
        jnp.asarray(np.stack([np.resize(x, (length, x.shape[1])) for x in column]), jnp.float32)
        for column in zip(*parts, strict=True)
    )
    count = jnp.asarray([len(task.inputs) for task in tasks], jnp.int32)
    mirror = jnp.asarray([task.mirror for task in tasks], jnp.float32)
    return _train(network, how, rows, count, mirror, keys)


Rows = tuple[jax.Array, jax.Array, jax.Array]  # inputs, targets and weights (n, ..)


@partial(jax.jit, static_argnames=("network", "how"))
def _train(
    network: ResidualNetwork,
    how: Training,
    rows: Rows,
    count: jax.Array,
    mirror: jax.Array,
    keys: jax.Array,
) -> Layers:
    def one(rows: Rows, count: jax.Array, mirror: jax.Array, keys: jax.Array) -> Layers:
        def loss(layers: Layers, part: Rows, key: jax.Array) -> jax.Array:
            inputs, targets, weights = part
            inputs, targets = _augmented(network, inputs, targets, mirror, key)
            square = weights * (mlp.apply(mlp.to_params(layers), inputs) - targets) ** 2
            return square.mean() + how.decay * (layers[-1][0] ** 2).sum()

        length = rows[0].shape[0]
        batch = min(how.batch, length)
        steps = -(-length // batch)
        cosine = optax.cosine_decay_schedule(how.learning_rate, how.epochs * steps)
        optimizer = optax.adam(cosine if how.cosine else how.learning_rate)
        Carry = tuple[Layers, optax.OptState, Layers]

        def step(carry: Carry, batch: tuple[jax.Array, jax.Array]) -> tuple[Carry, None]:
            (layers, state, mean), (index, key) = carry, batch
            inputs, targets, weights = (values[index % count] for values in rows)
            gradient = jax.grad(loss)(layers, (inputs, targets, weights), key)
            updates, state = optimizer.update(gradient, state)
            layers = optax.apply_updates(layers, updates)
            return (layers, state, optax.incremental_update(layers, mean, 1.0 - how.average)), None

        def epoch(carry: Carry, key: jax.Array) -> tuple[Carry, Layers]:
            of_order, of_steps = jax.random.split(key)
            order = jnp.resize(jax.random.permutation(of_order, length), (steps, batch))
            carry, _ = jax.lax.scan(step, carry, (order, jax.random.split(of_steps, steps)))
            return carry, carry[2]

        first, of_epochs = keys
        layers = _initial_layers(first, network.inputs, len(network.axes))
        start = (layers, optimizer.init(layers), layers)
        return jax.lax.scan(epoch, start, jax.random.split(of_epochs, how.epochs))[1]

    by_seed = jax.vmap(one, (None, None, None, 0))
    return jax.vmap(by_seed, (0, 0, 0, None))(rows, count, mirror, keys)


def _initial_layers(key: jax.Array, inputs: int, outputs: int) -> Layers:
    """One hidden layer whose kinks cover standardized inputs, and a small last layer."""
    first, bias, last = jax.random.split(key, 3)
    biases = jax.random.uniform(bias, (HIDDEN,), minval=-1.0, maxval=1.0)
    hidden = he_normal()(first, (inputs, HIDDEN)), biases
    return hidden, (0.01 * jax.random.normal(last, (HIDDEN, outputs)), jnp.zeros(outputs))


def _augmented(
    network: ResidualNetwork,
    inputs: jax.Array,
    targets: jax.Array,
    mirror: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Inputs and targets of a batch: half of it mirrored, with noise, where ``mirror`` is 1."""
    of_flip, of_noise = jax.random.split(key)
    flip = jax.random.uniform(of_flip, (len(inputs), 1)) < 0.5 * mirror
    sign = MIRROR_SIGN[: network.inputs].astype(np.float32)
    image = inputs[:, MIRROR_ORDER[: network.inputs]] * sign
    opposite = np.array([MIRROR_OUTPUT[axis] for axis in network.axes], np.float32)
    inputs = jnp.where(flip, image, inputs)
    targets = jnp.where(flip, targets * opposite, targets)
    return inputs + NOISE * mirror * jax.random.normal(of_noise, inputs.shape), targets
