"""From an ensemble to one network of the residual file's size.

The file holds one small network, because the simulation evaluates it millions of times. It is
taught by the ensemble: its targets are the ensemble's mean, after stopping and shrinking, so they
hold no noise and can be made for any input. Beyond the range that the logs have seen the target is
the ensemble's output at the nearest input within, so that the network learns to stay level there
rather than to carry a slope on to where nothing was measured.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax

from quadjax.fitting.choose import Choice
from quadjax.fitting.config import ResidualConfig
from quadjax.fitting.problem import Network, Task, mirrored
from quadjax.fitting.train import Params, ResidualNetwork, predict
from quadjax.vehicle.residual import Layers


@dataclass(frozen=True)
class Teacher:
    """The chosen ensemble of one network: per axis its task, its weights and its scale."""

    network: Network
    choices: list[Choice]
    tasks: list[Task]  # one per axis
    params: list[Params]  # one per axis, every leaf (seed, ..)

    def __call__(self, inputs: np.ndarray) -> np.ndarray:
        """Outputs (n, o), SI, of inputs (n, i) in the file's units."""
        columns = []
        for column, (choice, task, params) in enumerate(
            zip(self.choices, self.tasks, self.params, strict=True)
        ):
            if choice.scale == 0.0:
                columns.append(np.zeros(len(inputs)))
                continue
            within = np.clip(inputs, task.low, task.high)
            scaled = jnp.asarray((within - task.centre) / task.scale, jnp.float32)
            mean = np.asarray(_mean_output(params, scaled), np.float64)[:, column]
            columns.append(choice.scale * task.error_scale[column] * mean)
        return np.stack(columns, axis=1)


@jax.jit
def _mean_output(params: Params, inputs: jax.Array) -> jax.Array:
    return jax.vmap(partial(predict, inputs=inputs))(params).mean(axis=0)


def teach(
    teachers: list[Teacher], config: ResidualConfig, seed: int
) -> list[tuple[Layers, np.ndarray]]:
    """Teach one network for each teacher, all at once.

    Returns:
        For each, its layers in the file's units, and how much of the variance of the teacher's
        outputs it reproduces (o,), on the flights it was taught on (one where there is none).
    """
    network = teachers[0].network
    hidden = getattr(config, f"hidden_{network.name}")
    random = np.random.default_rng(seed)
    lessons = [_lesson(teacher, config.margin, random) for teacher in teachers]
    length = min(len(inputs) for inputs, _, _ in lessons)
    picks = [random.permutation(len(inputs))[:length] for inputs, _, _ in lessons]

    def stacked(part: int) -> jax.Array:
        rows = [lesson[part][pick] for lesson, pick in zip(lessons, picks, strict=True)]
        return jnp.asarray(np.stack(rows), jnp.float32)

    students = _teach_all(
        hidden, config.teach_epochs, stacked(0), stacked(1), stacked(2), jax.random.key(seed)
    )
    return [
        _finish(teacher, jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i], np.float64), students))
        for i, teacher in enumerate(teachers)
    ]


def _scales(teacher: Teacher) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre and scale of the inputs, and scale of the outputs, that the student learns in."""
    task = teacher.tasks[0]
    outputs = teacher(task.inputs * task.scale + task.centre)
    return task.centre, task.scale, np.maximum(np.sqrt((outputs**2).mean(axis=0)), 1e-9)


def _lesson(
    teacher: Teacher, margin: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inputs, targets and weights of every row: as flown, and stretched beyond the range."""
    task, network = teacher.tasks[0], teacher.network
    flown = task.inputs * task.scale + task.centre
    weights = task.weights
    if any(choice.mirror and choice.scale > 0.0 for choice in teacher.choices):
        flown = np.concatenate([flown, mirrored(network, flown)])
        weights = np.concatenate([weights, weights])
    middle = 0.5 * (task.low + task.high)
    stretch = 1.0 + margin * random.uniform(size=(len(flown), 1))
    blur = 0.1 * task.scale * random.normal(size=flown.shape)
    beyond = middle + stretch * (flown - middle) + blur
    inputs = np.concatenate([flown, beyond])
    centre, scale, size = _scales(teacher)
    return (inputs - centre) / scale, teacher(inputs) / size, np.concatenate([weights, weights])


@partial(jax.jit, static_argnames=("hidden", "epochs"))
def _teach_all(
    hidden: int,
    epochs: int,
    inputs: jax.Array,
    targets: jax.Array,
    weights: jax.Array,
    key: jax.Array,
) -> Params:
    batch = min(256, inputs.shape[1])
    steps = inputs.shape[1] // batch
    network = ResidualNetwork(hidden, targets.shape[-1])
    optimiser = optax.adam(optax.cosine_decay_schedule(1e-2, epochs * steps))

    def loss(params: Params, x: jax.Array, y: jax.Array, w: jax.Array) -> jax.Array:
        return (w * (network.apply(params, x) - y) ** 2).mean()

    def one(x: jax.Array, y: jax.Array, w: jax.Array) -> Params:
        def step(
            carry: tuple[Params, optax.OptState], rows: jax.Array
        ) -> tuple[tuple[Params, optax.OptState], None]:
            params, state = carry
            gradient = jax.grad(loss)(params, x[rows], y[rows], w[rows])
            updates, state = optimiser.update(gradient, state)
            return (optax.apply_updates(params, updates), state), None

        def epoch(
            carry: tuple[Params, optax.OptState], epoch_key: jax.Array
        ) -> tuple[tuple[Params, optax.OptState], None]:
            order = jax.random.permutation(epoch_key, x.shape[0])[: steps * batch]
            return jax.lax.scan(step, carry, order.reshape(steps, batch))

        params = network.init(key, x[0])
        carry = (params, optimiser.init(params))
        (params, _), _ = jax.lax.scan(epoch, carry, jax.random.split(key, epochs))
        return params

    return jax.vmap(one)(inputs, targets, weights)


def _finish(teacher: Teacher, params: Params) -> tuple[Layers, np.ndarray]:
    """Fold the scaling into the weights, silence refused axes, and grade the student."""
    centre, scale, size = _scales(teacher)
    first, last = params["params"]["Dense_0"], params["params"]["Dense_1"]
    kept = np.array([choice.scale > 0.0 for choice in teacher.choices])
    kernel = first["kernel"] / scale[:, None]
    layers = (
        (kernel, first["bias"] - centre @ kernel),
        (np.where(kept, last["kernel"] * size, 0.0), np.where(kept, last["bias"] * size, 0.0)),
    )
    task = teacher.tasks[0]
    flown = task.inputs * task.scale + task.centre
    wanted = teacher(flown)
    hidden = np.maximum(flown @ layers[0][0] + layers[0][1], 0.0)
    wrong = ((hidden @ layers[1][0] + layers[1][1] - wanted) ** 2).mean(axis=0)
    spread = wanted.var(axis=0)
    grade = np.where(kept, 1.0 - wrong / np.maximum(spread, 1e-30), 1.0)
    as_arrays = tuple((jnp.asarray(k, jnp.float32), jnp.asarray(b, jnp.float32)) for k, b in layers)
    return as_arrays, grade
