"""What a training run carries, and what a learner is."""

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from quadjax.core.environment import Environment
from quadjax.learners.networks import ActorCritic

Params = TypeVar("Params")
AXIS = "environments"  # name of the mesh axis over which a batch of environments is split


@struct.dataclass
class TrainState:
    """Everything that a run needs to go on: all of it is in a checkpoint."""

    params: ActorCritic
    optimiser: optax.OptState
    target: ActorCritic | None  # slowly moving copy, for learners that keep one
    environment: object  # states of all environments, batched along the last axis
    keys: jax.Array  # (lanes,) PRNG keys
    update: jax.Array  # () int32, updates done
    mean: ActorCritic | None = None  # running mean of ``params``, for learners that keep one

    @property
    def flown(self) -> ActorCritic:
        """What is timed and kept: the running mean where there is one."""
        return self.params if self.mean is None else self.mean


Metrics = dict[str, jax.Array]
Update = Callable[[object, object, TrainState], tuple[TrainState, Metrics]]


@dataclasses.dataclass(frozen=True)
class Learner(Generic[Params]):
    """One algorithm, bound to an environment: what the loop drives.

    ``init(hyper, environment_params, key)`` returns the first state of a run.
    ``update(hyper, environment_params, state)`` does one update on one device's part of the
    environments and averages over the mesh axis ``AXIS``. Hyperparameters are traced.
    """

    init: Callable[[Any, Params, jax.Array], TrainState]
    update: Update
    hyper: object  # pytree of float hyperparameters
    steps_per_update: int  # environment steps of one update, all environments together
    num_shards: int  # equal parts of the environments that devices can share


def count_lanes(environments: int, blocks: int = 1, batches: int = 1, most: int = 8) -> int:
    """Into how many equal lanes a batch of environments divides: a power of two up to ``most``.

    Each lane draws from its own key and shuffles within itself, so that a run is the same however
    many devices share the lanes.

    Args:
        environments: how many there are.
        blocks: pieces of an update's rollout that are shuffled, per environment.
        batches: into which the pieces of each lane must divide.
        most: upper bound.
    """
    lanes = most
    while lanes > 1 and (environments % lanes or environments // lanes * blocks % batches):
        lanes //= 2
    return lanes


def reset_all(environment: Environment, params: object, keys: jax.Array, count: int) -> object:
    """Fresh environment states, ``count`` for each lane's key, batched along the last axis."""
    split = jax.vmap(lambda key: jax.random.split(key, count))(keys).reshape(-1)
    return jax.vmap(environment.reset, in_axes=(None, 0), out_axes=-1)(params, split)


def normal_all(keys: jax.Array, shape: tuple[int, ...], count: int, size: int) -> jax.Array:
    """Standard normal numbers (*shape, lanes * count, size), each lane's from its own key."""
    noise = jax.vmap(lambda key: jax.random.normal(key, (*shape, count, size)))(keys)
    return jnp.moveaxis(noise, 0, len(shape)).reshape(*shape, -1, size)


def where_done(done: jax.Array, fresh: object, state: object) -> object:
    """``fresh`` where an episode is done, else ``state``; both batched along the last axis."""
    return jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, state)


def split_keys(keys: jax.Array, count: int) -> tuple[jax.Array, ...]:
    """``count`` new key arrays (lanes,) from one."""
    return tuple(jnp.moveaxis(jax.vmap(lambda key: jax.random.split(key, count))(keys), 1, 0))


def select_finite(fine: jax.Array, new: object, old: object) -> object:
    """``new`` if ``fine`` () else ``old``, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(fine, a, b), new, old)


def linear(start: jax.Array, end: jax.Array, fraction: jax.Array) -> jax.Array:
    """From ``start`` to ``end`` as ``fraction`` goes from 0 to 1, then ``end``."""
    return start + (end - start) * jnp.clip(fraction, 0.0, 1.0)


def clip_by_norm(tree: object, limit: jax.Array) -> tuple[object, jax.Array]:
    """A gradient scaled to a global norm of at most ``limit``, and the norm before."""
    norm = optax.tree.norm(tree)
    scale = jnp.minimum(1.0, limit / jnp.maximum(norm, 1e-12))
    return jax.tree.map(lambda g: g * scale, tree), norm


def mean_of_all(x: jax.Array) -> jax.Array:
    """The mean () over all entries of ``x`` on all devices."""
    return jax.lax.pmean(jnp.mean(x.astype(jnp.float32)), AXIS)


def episode_metrics(reward: jax.Array, terminated: jax.Array, truncated: jax.Array) -> Metrics:
    """Scalars of all steps (time, n) of an update, over all devices."""
    chex.assert_equal_shape((reward, terminated, truncated))
    terminated, truncated = mean_of_all(terminated), mean_of_all(truncated)
    return {
        "reward": mean_of_all(reward),
        "crash_rate": terminated / jnp.maximum(terminated + truncated, 1e-9),
        "terminated": terminated,
    }
