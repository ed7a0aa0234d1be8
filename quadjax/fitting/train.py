"""Training of many small networks at once: every task and seed in one compiled program."""

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.nn.initializers import he_normal

from quadjax.core import mlp
from quadjax.core.mlp import Layers
from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.tasks import ResidualNetwork, Task

Rows = dict[str, jax.Array]  # (n, ..)


ROWS = 512  # numbers of rows are padded to multiples of it, so that fits share compiled programs


def padded(count: int) -> int:
    """A number of rows with padding."""
    return -(-count // ROWS) * ROWS


def initial_layers(key: jax.Array, inputs: int, hidden: int, outputs: int) -> Layers:
    """One hidden layer whose kinks cover standardized inputs, and a small last layer."""
    first, bias, last = jax.random.split(key, 3)
    return (
        (
            he_normal()(first, (inputs, hidden)),
            jax.random.uniform(bias, (hidden,), minval=-1.0, maxval=1.0),
        ),
        (0.01 * jax.random.normal(last, (hidden, outputs)), jnp.zeros(outputs)),
    )


def minimize(
    loss: Callable[[Layers, Rows, jax.Array], jax.Array],
    layers: Layers,
    learning_rate: float | optax.Schedule,
    rows: Rows,
    count: jax.Array | int,
    batch: int,
    keys: jax.Array,
    average: float = 0.0,
) -> Layers:
    """Adam over epochs of minibatches.

    Args:
        loss: ``(layers, rows (batch, ..), key) -> ()``.
        layers: to start from.
        learning_rate: a number or a schedule over steps.
        rows: data (n, ..), of which the first ``count`` are not padding.
        count: number of rows.
        batch: rows of a minibatch.
        keys: one per epoch.
        average: decay of the exponential moving average of the layers; 0 for none.

    Returns:
        The averaged layers after each epoch: leaves (epochs, ..).
    """
    optimizer, length = optax.adam(learning_rate), len(next(iter(rows.values())))
    steps = -(-length // batch)
    Carry = tuple[Layers, optax.OptState, Layers]

    def step(carry: Carry, drawn: tuple[jax.Array, jax.Array]) -> tuple[Carry, None]:
        layers, state, mean = carry
        index, key = drawn
        part = {name: values[index % count] for name, values in rows.items()}
        updates, state = optimizer.update(jax.grad(loss)(layers, part, key), state)
        layers = optax.apply_updates(layers, updates)
        return (layers, state, optax.incremental_update(layers, mean, 1.0 - average)), None

    def epoch(carry: Carry, key: jax.Array) -> tuple[Carry, Layers]:
        of_order, of_steps = jax.random.split(key)
        order = jnp.resize(jax.random.permutation(of_order, length), (steps, batch))
        carry, _ = jax.lax.scan(step, carry, (order, jax.random.split(of_steps, steps)))
        return carry, carry[2]

    return jax.lax.scan(epoch, (layers, optimizer.init(layers), layers), keys)[1]


def train_tasks(
    network: ResidualNetwork, tasks: list[Task], config: ResidualConfig, seed: int
) -> Layers:
    """Train every task with every seed.

    Returns:
        The averaged layers after each epoch: leaves (task, seed, epoch, ..).
    """
    length = padded(max(len(task.inputs) for task in tasks))

    def stacked(name: str) -> jax.Array:
        same = [np.resize(getattr(t, name), (length, getattr(t, name).shape[1])) for t in tasks]
        return jnp.asarray(np.stack(same), jnp.float32)

    rows = {name: stacked(name) for name in ("inputs", "errors", "weights")}
    counts = jnp.asarray([len(task.inputs) for task in tasks], jnp.int32)
    mirror = jnp.asarray([task.mirror for task in tasks], jnp.float32)
    keys = jax.random.split(jax.random.key(seed), config.seeds)
    history = _train_all(network, config, rows, counts, mirror, keys)
    return jax.tree.map(np.asarray, history)


@partial(jax.jit, static_argnames=("network", "config"))
def _train_all(
    network: ResidualNetwork,
    config: ResidualConfig,
    rows: Rows,
    counts: jax.Array,
    mirror: jax.Array,
    keys: jax.Array,
) -> Layers:
    hidden = network.hidden(config)
    batch = min(config.batch, rows["inputs"].shape[1])

    def loss(layers: Layers, part: Rows, key: jax.Array) -> jax.Array:
        square = part["weights"] * (mlp.apply(layers, part["inputs"]) - part["errors"]) ** 2
        return square.mean() + config.decay * (layers[-1][0] ** 2).sum()

    def one(rows: Rows, count: jax.Array, mirror: jax.Array, key: jax.Array) -> Layers:
        of_layers, of_epochs = jax.random.split(key)
        start = initial_layers(of_layers, network.inputs, hidden, len(network.axes))
        return minimize(
            lambda layers, part, key: loss(
                layers, _augment(network, config, part, mirror, key), key
            ),
            start,
            config.learning_rate,
            rows,
            count,
            batch,
            jax.random.split(of_epochs, config.epochs),
            config.average,
        )

    return jax.vmap(jax.vmap(one, (None, None, None, 0)), (0, 0, 0, None))(
        rows, counts, mirror, keys
    )


def _augment(
    network: ResidualNetwork, config: ResidualConfig, part: Rows, mirror: jax.Array, key: jax.Array
) -> Rows:
    """Mirror half of a batch and add noise to its inputs, where ``mirror`` is 1."""
    of_flip, of_noise = jax.random.split(key)
    inputs, errors = part["inputs"], part["errors"]
    flip = jax.random.uniform(of_flip, (len(inputs), 1)) < 0.5 * mirror
    image = inputs[:, np.array(network.mirror_order)] * np.array(network.mirror_sign, np.float32)
    inputs = jnp.where(flip, image, inputs)
    errors = jnp.where(flip, errors * np.array(network.mirror_output, np.float32), errors)
    noise = config.noise * mirror * jax.random.normal(of_noise, inputs.shape)
    return part | {"inputs": inputs + noise, "errors": errors}


@jax.jit
def mean_output(layers: Any, inputs: jax.Array) -> jax.Array:
    """Mean output (n, o) of an ensemble of networks, leaves (seed, ..)."""
    return jax.vmap(partial(mlp.apply, inputs=inputs))(layers).mean(axis=0)
