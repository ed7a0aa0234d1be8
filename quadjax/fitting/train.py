"""Training many small networks at once: every task and every seed in one compiled program."""

from dataclasses import dataclass
from functools import partial

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct

from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.problem import Network, Task

Params = dict[str, dict[str, dict[str, jax.Array]]]


class ResidualNetwork(nn.Module):
    """One hidden layer of ReLU."""

    hidden: int
    outputs: int

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Outputs (.., o) of standardised inputs (.., i)."""
        spread = nn.initializers.uniform(2.0)

        def bias(key: jax.Array, shape: tuple[int, ...], dtype: jnp.dtype) -> jax.Array:
            return spread(key, shape, dtype) - 1.0  # kinks all over the inputs' range

        small = nn.initializers.normal(0.01)
        hidden = nn.Dense(self.hidden, kernel_init=nn.initializers.he_normal(), bias_init=bias)
        return nn.Dense(self.outputs, kernel_init=small)(nn.relu(hidden(inputs)))


@struct.dataclass
class Rows:
    """Rows to learn from; a batch of tasks has one more axis in front, padded to equal length."""

    inputs: jax.Array  # (n, i)
    errors: jax.Array  # (n, o)
    weights: jax.Array  # (n, o)
    count: jax.Array  # () rows that are not padding
    noise: jax.Array  # () on the inputs
    flip: jax.Array  # () share of rows seen in a mirror


@dataclass(frozen=True)
class Recipe:
    """The static part of a training."""

    hidden: int
    outputs: int
    epochs: int
    steps: int  # per epoch
    batch: int
    average: float
    mirror_order: tuple[int, ...]
    mirror_sign: tuple[float, ...]
    mirror_output: tuple[float, ...]


def train_tasks(network: Network, tasks: list[Task], config: ResidualConfig, seed: int) -> Params:
    """Train every task with every seed.

    Returns:
        The averaged weights after each epoch, every leaf (task, seed, epoch, ..).
    """
    rows = _stack(tasks, config)
    length = rows.inputs.shape[1]
    batch = min(config.batch, length)
    recipe = Recipe(
        hidden=getattr(config, f"hidden_{network.name}"),
        outputs=len(network.axes),
        epochs=config.epochs,
        steps=-(-length // batch),
        batch=batch,
        average=config.average,
        mirror_order=network.mirror_order,
        mirror_sign=network.mirror_sign,
        mirror_output=network.mirror_output,
    )
    keys = jax.random.split(jax.random.key(seed), config.seeds)
    history = _train_all(recipe, rows, keys, config.learning_rate, config.decay)
    return jax.tree.map(np.asarray, history)


def predict(params: Params, inputs: jax.Array) -> jax.Array:
    """Standardised outputs (.., o) of one set of weights."""
    outputs = params["params"]["Dense_1"]["bias"].shape[-1]
    hidden = params["params"]["Dense_0"]["bias"].shape[-1]
    return ResidualNetwork(hidden, outputs).apply(params, inputs)


def _stack(tasks: list[Task], config: ResidualConfig) -> Rows:
    length = max(len(task.inputs) for task in tasks)

    def pad(values: np.ndarray) -> np.ndarray:
        return np.pad(values, ((0, length - len(values)), (0, 0)))

    def stacked(name: str) -> jax.Array:
        return jnp.asarray(np.stack([pad(getattr(task, name)) for task in tasks]), jnp.float32)

    mirror = np.array([task.mirror for task in tasks])
    return Rows(
        inputs=stacked("inputs"),
        errors=stacked("errors"),
        weights=stacked("weights"),
        count=jnp.asarray([len(task.inputs) for task in tasks], jnp.int32),
        noise=jnp.asarray(np.where(mirror, config.noise, 0.0), jnp.float32),
        flip=jnp.asarray(np.where(mirror, 0.5, 0.0), jnp.float32),
    )


@partial(jax.jit, static_argnames="recipe")
def _train_all(
    recipe: Recipe, rows: Rows, keys: jax.Array, learning_rate: float, decay: float
) -> Params:
    one = partial(_train_one, recipe, learning_rate=learning_rate, decay=decay)
    over_seeds = jax.vmap(one, in_axes=(None, 0))
    return jax.vmap(over_seeds, in_axes=(0, None))(rows, keys)


def _train_one(
    recipe: Recipe, rows: Rows, key: jax.Array, learning_rate: float, decay: float
) -> Params:
    """Whole epochs in a scan; the weights' average after each is what comes back."""
    network = ResidualNetwork(recipe.hidden, recipe.outputs)
    optimiser = optax.adam(learning_rate)
    init_key, epoch_key = jax.random.split(key)
    params = network.init(init_key, rows.inputs[0])

    def loss(params: Params, inputs: jax.Array, errors: jax.Array, weights: jax.Array) -> jax.Array:
        square = weights * (network.apply(params, inputs) - errors) ** 2
        return square.mean() + decay * (params["params"]["Dense_1"]["kernel"] ** 2).sum()

    def step(
        carry: tuple[Params, optax.OptState, Params], scanned: tuple[jax.Array, jax.Array]
    ) -> tuple[tuple[Params, optax.OptState, Params], None]:
        params, state, average = carry
        index, key = scanned
        gradient = jax.grad(loss)(params, *_draw(recipe, rows, index, key))
        updates, state = optimiser.update(gradient, state)
        params = optax.apply_updates(params, updates)
        keep = recipe.average
        average = jax.tree.map(lambda a, p: keep * a + (1.0 - keep) * p, average, params)
        return (params, state, average), None

    def epoch(
        carry: tuple[Params, optax.OptState, Params], key: jax.Array
    ) -> tuple[tuple[Params, optax.OptState, Params], Params]:
        order_key, draw_key = jax.random.split(key)
        length = rows.inputs.shape[0]
        order = jax.random.permutation(order_key, length)
        order = jnp.resize(order, (recipe.steps, recipe.batch))
        carry, _ = jax.lax.scan(step, carry, (order, jax.random.split(draw_key, recipe.steps)))
        return carry, carry[2]

    start = (params, optimiser.init(params), params)
    _, history = jax.lax.scan(epoch, start, jax.random.split(epoch_key, recipe.epochs))
    return history


def _draw(
    recipe: Recipe, rows: Rows, index: jax.Array, key: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """One batch: some of it in a mirror, with noise on the inputs."""
    index = index % rows.count
    inputs, errors, weights = rows.inputs[index], rows.errors[index], rows.weights[index]
    flip_key, noise_key = jax.random.split(key)
    flip = jax.random.uniform(flip_key, (recipe.batch, 1)) < rows.flip
    sign = jnp.asarray(recipe.mirror_sign, jnp.float32)[None, :]
    image = inputs[:, jnp.asarray(recipe.mirror_order)] * sign
    inputs = jnp.where(flip, image, inputs)
    output_sign = jnp.asarray(recipe.mirror_output, jnp.float32)[None, :]
    errors = jnp.where(flip, errors * output_sign, errors)
    return inputs + rows.noise * jax.random.normal(noise_key, inputs.shape), errors, weights
