"""Training of the residual networks: every training of one network in one compiled program.

A network is trained many times, each time without some folds. Every such *task* has its own nominal
model and scaling, so that it contains no information of the folds left out.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jax.nn.initializers import he_normal

from quadjax.core import mlp
from quadjax.core.mlp import Layers
from quadjax.fitting.axes import nominal_error
from quadjax.fitting.nominal import AXES, Constants, file_inputs
from quadjax.fitting.prepare import Samples

Rows = dict[str, jax.Array]  # (n, ..)
PADDING = 512  # numbers of rows are padded to multiples of it, so that fits share programs
NOISE = 0.1  # of the inputs with mirroring, in standard deviations


class Training(NamedTuple):
    """How a network is trained."""

    epochs: int
    batch: int = 128
    learning_rate: float = 3e-3  # of Adam
    cosine: bool = False  # decay of the learning rate to zero
    decay: float = 1e-3  # L2 penalty on the last layer
    average: float = 0.99  # decay of the averaged layers


@dataclass(frozen=True)
class ResidualNetwork:
    """One of the two residual networks: its axes and its mirror symmetry."""

    name: str
    axes: tuple[str, ...]
    inputs: int
    # Left and right swapped: motors 1 <-> 2 and 3 <-> 4, and vy, p, r, Mx, Mz change sign.
    mirror_order: tuple[int, ...]
    mirror_sign: tuple[float, ...]
    mirror_output: tuple[float, ...]
    hidden: int = 32

    @property
    def columns(self) -> list[int]:
        """Indices of its axes in ``AXES``."""
        return [AXES.index(axis) for axis in self.axes]


_ORDER = (1, 0, 3, 2, 4, 5, 6)
_SIGN = (1.0, 1.0, 1.0, 1.0, 1.0, -1.0, 1.0)
NETWORKS = {
    "thrust": ResidualNetwork("thrust", ("az",), 7, _ORDER, _SIGN, (1.0,)),
    "moment": ResidualNetwork(
        "moment",
        ("Mx", "My", "Mz"),
        10,
        (*_ORDER, 7, 8, 9),
        (*_SIGN, -1.0, 1.0, -1.0),
        (-1.0, 1.0, -1.0),
    ),
}


@struct.dataclass
class Tasks:
    """Trainings of one network, t of them, each with and scaled by its own rows."""

    inputs: np.ndarray  # (t, n, i) standardized; rows beyond the count repeat the first ones
    errors: np.ndarray  # (t, n, o) of the nominal model, standardized
    weights: np.ndarray  # (t, n, o) the same total per fold
    count: np.ndarray  # (t,) rows
    mirror: np.ndarray  # (t,) bool
    center: np.ndarray  # (t, i) of the inputs, file units
    scale: np.ndarray  # (t, i)
    low: np.ndarray  # (t, i) range of the inputs, file units
    high: np.ndarray  # (t, i)
    error_scale: np.ndarray  # (t, o) root mean square error of the nominal model

    def __getitem__(self, index: int) -> "Tasks":
        """One task, without the leading axis and the padding."""
        one = jax.tree.map(lambda values: values[index], self)
        rows = slice(int(one.count))
        return one.replace(
            inputs=one.inputs[rows], errors=one.errors[rows], weights=one.weights[rows]
        )


def mirrored(network: ResidualNetwork, inputs: np.ndarray) -> np.ndarray:
    """Inputs (n, i) of the mirrored flight."""
    return inputs[:, list(network.mirror_order)] * np.array(network.mirror_sign)


def padded(count: int) -> int:
    """A number of rows with padding."""
    return -(-count // PADDING) * PADDING


def make_tasks(
    network: ResidualNetwork,
    samples: Samples,
    fold: np.ndarray,
    cases: Sequence[tuple[np.ndarray, bool, Constants]],
    rpm_range: tuple[float, float],
) -> Tasks:
    """The trainings of a network.

    Args:
        network: of the two.
        samples: n rows.
        fold: (n,) of each.
        cases: rows (n,) bool, whether their mirror images are used, and the nominal model.
        rpm_range: of the inputs of a residual file, rpm.
    """
    tasks = [_task(network, samples[r], fold[r], m, c, rpm_range) for r, m, c in cases]
    length = padded(max(int(task.count) for task in tasks))

    def repeated(values: np.ndarray) -> np.ndarray:
        return np.resize(values, (length, values.shape[1]))

    same = [
        task.replace(
            inputs=repeated(task.inputs),
            errors=repeated(task.errors),
            weights=repeated(task.weights),
        )
        for task in tasks
    ]
    return jax.tree.map(lambda *values: np.stack(values), *same)


def _task(
    network: ResidualNetwork,
    samples: Samples,
    fold: np.ndarray,
    mirror: bool,
    constants: Constants,
    rpm_range: tuple[float, float],
) -> Tasks:
    """One training, standardized by its rows."""
    inputs = file_inputs(samples.motion, rpm_range)[:, : network.inputs]
    errors = nominal_error(samples, constants)[:, network.columns]
    seen = np.concatenate([inputs, mirrored(network, inputs)]) if mirror else inputs
    center, scale = seen.mean(axis=0), np.maximum(seen.std(axis=0), 1e-6)
    error_scale = np.maximum(np.sqrt((errors**2).mean(axis=0)), 1e-12)
    weights = np.ones_like(errors)
    for number in np.unique(fold):
        here = fold == number
        weights[here] = error_scale**2 / np.maximum((errors[here] ** 2).mean(axis=0), 1e-24)
    return Tasks(
        inputs=(inputs - center) / scale,
        errors=errors / error_scale,
        weights=weights / weights.mean(axis=0),
        count=np.array(len(inputs)),
        mirror=np.array(mirror),
        center=center,
        scale=scale,
        low=seen.min(axis=0),
        high=seen.max(axis=0),
        error_scale=error_scale,
    )


def train(network: ResidualNetwork, tasks: Tasks, how: Training, seed: int, seeds: int) -> Layers:
    """Train every task with every seed.

    Returns:
        The averaged layers after each epoch: leaves (task, seed, epoch, ..).
    """
    keys = jax.random.split(jax.random.key(seed), seeds)
    of_layers, of_epochs = jax.vmap(lambda key: jax.random.split(key))(keys).T
    rows = {"inputs": tasks.inputs, "targets": tasks.errors, "weights": tasks.weights}
    history = train_rows(network, how, rows, tasks.count, tasks.mirror, of_layers, of_epochs)
    return jax.tree.map(np.asarray, history)


def train_rows(
    network: ResidualNetwork,
    how: Training,
    rows: dict[str, np.ndarray],
    count: np.ndarray,
    mirror: np.ndarray,
    of_layers: jax.Array,
    of_epochs: jax.Array,
) -> Layers:
    """Train on inputs, targets and weights (task, n, ..), of which ``count`` are no padding.

    Args:
        network: of the two.
        how: it is trained.
        rows: the data.
        count: (task,) rows.
        mirror: (task,) bool, whether on mirror images as well.
        of_layers: (seed,) keys of the first layers.
        of_epochs: (seed,) keys of the epochs.

    Returns:
        The averaged layers after each epoch: leaves (task, seed, epoch, ..).
    """
    data = {name: jnp.asarray(values, jnp.float32) for name, values in rows.items()}
    numbers = jnp.asarray(count, jnp.int32), jnp.asarray(mirror, jnp.float32)
    return _train_all(network, how, data, *numbers, of_layers, of_epochs)


@partial(jax.jit, static_argnames=("network", "how"))
def _train_all(
    network: ResidualNetwork,
    how: Training,
    rows: Rows,
    count: jax.Array,
    mirror: jax.Array,
    of_layers: jax.Array,
    of_epochs: jax.Array,
) -> Layers:
    def loss(mirror: jax.Array, layers: Layers, part: Rows, key: jax.Array) -> jax.Array:
        inputs, targets = _augmented(network, part, mirror, key)
        square = part["weights"] * (mlp.apply(layers, inputs) - targets) ** 2
        return square.mean() + how.decay * (layers[-1][0] ** 2).sum()

    def one(
        rows: Rows, count: jax.Array, mirror: jax.Array, first: jax.Array, epochs: jax.Array
    ) -> Layers:
        start = _initial_layers(first, network.inputs, network.hidden, len(network.axes))
        return _minimize(partial(loss, mirror), start, how, rows, count, epochs)

    by_seed = jax.vmap(one, (None, None, None, 0, 0))
    return jax.vmap(by_seed, (0, 0, 0, None, None))(rows, count, mirror, of_layers, of_epochs)


def _minimize(
    loss: Callable[[Layers, Rows, jax.Array], jax.Array],
    layers: Layers,
    how: Training,
    rows: Rows,
    count: jax.Array,
    key: jax.Array,
) -> Layers:
    """Adam over epochs of minibatches; the averaged layers after each epoch."""
    length = len(rows["inputs"])
    batch = min(how.batch, length)
    steps = -(-length // batch)
    cosine = optax.cosine_decay_schedule(how.learning_rate, how.epochs * steps)
    optimizer = optax.adam(cosine if how.cosine else how.learning_rate)
    Carry = tuple[Layers, optax.OptState, Layers]

    def step(carry: Carry, drawn: tuple[jax.Array, jax.Array]) -> tuple[Carry, None]:
        layers, state, mean = carry
        index, key = drawn
        part = {name: values[index % count] for name, values in rows.items()}
        updates, state = optimizer.update(jax.grad(loss)(layers, part, key), state)
        layers = optax.apply_updates(layers, updates)
        return (layers, state, optax.incremental_update(layers, mean, 1.0 - how.average)), None

    def epoch(carry: Carry, key: jax.Array) -> tuple[Carry, Layers]:
        of_order, of_steps = jax.random.split(key)
        order = jnp.resize(jax.random.permutation(of_order, length), (steps, batch))
        carry, _ = jax.lax.scan(step, carry, (order, jax.random.split(of_steps, steps)))
        return carry, carry[2]

    keys = jax.random.split(key, how.epochs)
    return jax.lax.scan(epoch, (layers, optimizer.init(layers), layers), keys)[1]


def _initial_layers(key: jax.Array, inputs: int, hidden: int, outputs: int) -> Layers:
    """One hidden layer whose kinks cover standardized inputs, and a small last layer."""
    first, bias, last = jax.random.split(key, 3)
    return (
        (
            he_normal()(first, (inputs, hidden)),
            jax.random.uniform(bias, (hidden,), minval=-1.0, maxval=1.0),
        ),
        (0.01 * jax.random.normal(last, (hidden, outputs)), jnp.zeros(outputs)),
    )


def _augmented(
    network: ResidualNetwork, part: Rows, mirror: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Inputs and targets of a batch: half of it mirrored, with noise, where ``mirror`` is 1."""
    of_flip, of_noise = jax.random.split(key)
    inputs, targets = part["inputs"], part["targets"]
    flip = jax.random.uniform(of_flip, (len(inputs), 1)) < 0.5 * mirror
    image = inputs[:, np.array(network.mirror_order)] * np.array(network.mirror_sign, np.float32)
    inputs = jnp.where(flip, image, inputs)
    targets = jnp.where(flip, targets * np.array(network.mirror_output, np.float32), targets)
    noise = NOISE * mirror * jax.random.normal(of_noise, inputs.shape)
    return inputs + noise, targets
