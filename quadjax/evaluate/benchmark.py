"""Speed of the environment and of training, compile time apart."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import NamedSharding, PartitionSpec

from quadjax.learn import parallel
from quadjax.learn.state import AXIS, where_done
from quadjax.race.build import choices_of
from quadjax.race.environment import RaceParams, make_environment
from quadjax.schema import Config
from quadjax.vehicle.residual import Residual


@dataclasses.dataclass(frozen=True)
class Speed:
    """One measurement."""

    drones: int
    devices: int
    compile_seconds: float
    steps_per_second: float  # median over the repeats
    slowest: float  # steps/s of the slowest repeat
    fastest: float


def random_residual(seed: int = 0, width: int = 32) -> Residual:
    """Residual networks of the usual size with small random weights."""
    random = np.random.default_rng(seed)

    def layers(inputs: int, outputs: int, size: float) -> tuple:
        shapes = ((inputs, width, 0.1), (width, outputs, size))
        return tuple(
            (
                jnp.asarray(scale * random.normal(size=(rows, columns)), jnp.float32),
                jnp.zeros(columns, jnp.float32),
            )
            for rows, columns, scale in shapes
        )

    numbers = (jnp.float32(x) for x in (3000.0, 11000.0, 1.0))
    return Residual(layers(7, 1, 0.1), layers(10, 3, 1e-3), *numbers)


def environment_loop(
    config: Config, params: RaceParams, drones: int, steps: int, devices: int, observed: bool
) -> tuple[Callable, tuple]:
    """A compiled loop of steps with automatic resets, split over devices, and its arguments.

    Args:
        config: of the race.
        params: its numbers; they are arguments of the loop, as in training.
        drones: in all.
        steps: of each drone in a call.
        devices: over which the drones are split.
        observed: whether every step makes the observation too.
    """
    environment = make_environment(choices_of(config))
    step = jax.vmap(environment.step, in_axes=(None, -1, 0), out_axes=(-1, 0, 0, 0))
    observe = jax.vmap(environment.observe, in_axes=(None, -1))

    def loop(params: RaceParams, state: object, fresh: object, action: jax.Array) -> tuple:
        def one(carry: tuple, _: None) -> tuple[tuple, None]:
            state, total = carry
            following, reward, terminated, truncated = step(params, state, action)
            following = where_done(terminated | truncated, fresh, following)
            total = total + reward
            if observed:
                total = total + observe(params, following).sum(axis=1)
            return (following, total), None

        return jax.lax.scan(one, (state, jnp.zeros(action.shape[0])), None, steps)[0]

    mesh = parallel.make_mesh(devices)
    reset = jax.jit(jax.vmap(environment.reset, in_axes=(None, 0), out_axes=-1))
    state = reset(params, jax.random.split(jax.random.key(0), drones))
    action = jax.random.uniform(jax.random.key(1), (drones, 4), minval=-1.0, maxval=1.0)
    shared = PartitionSpec()
    split = jax.tree.map(lambda x: PartitionSpec(*(None,) * (x.ndim - 1), AXIS), state)
    specs = (shared, split, split, PartitionSpec(AXIS))
    sharded = jax.shard_map(
        loop, mesh=mesh, in_specs=specs, out_specs=(split, PartitionSpec(AXIS)), check_vma=False
    )

    def place(tree: object, spec: object) -> object:
        return jax.tree.map(lambda x, s: jax.device_put(x, NamedSharding(mesh, s)), tree, spec)

    placed = place(state, split)
    arguments = (params, placed, placed, jax.device_put(action, NamedSharding(mesh, specs[3])))
    return jax.jit(sharded, compiler_options=parallel.compile_options()), arguments
