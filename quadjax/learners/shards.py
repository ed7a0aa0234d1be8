"""Batches of environments in shards: equal parts, each with its own PRNG key.

A shard draws its random numbers from its own key and shuffles within itself. The result of a run is
therefore the same, up to rounding, on any number of devices that divides the number of shards.
"""

from typing import Any

import jax
import jax.numpy as jnp

from quadjax.core.environment import Environment


def count_shards(
    num_envs: int, blocks: int = 1, num_minibatches: int = 1, max_shards: int = 8
) -> int:
    """The number of shards of a batch of environments: a power of two up to ``max_shards``.

    Args:
        num_envs: number of environments.
        blocks: blocks of an environment's steps that are shuffled.
        num_minibatches: into which the blocks of each shard are divided.
        max_shards: upper bound.
    """
    shards = max_shards
    while shards > 1 and (num_envs % shards or num_envs // shards * blocks % num_minibatches):
        shards //= 2
    return shards


def reset_all(environment: Environment, params: Any, keys: jax.Array, count: int) -> Any:
    """New environment states, ``count`` for each shard's key, batched along the last axis."""
    split = jax.vmap(lambda key: jax.random.split(key, count))(keys).reshape(-1)
    return jax.vmap(environment.reset, in_axes=(None, 0), out_axes=-1)(params, split)


def envs_per_shard(state: Any, keys: jax.Array) -> int:
    """Environments of a shard, from batched environment states and the shards' keys."""
    return jax.tree.leaves(state)[0].shape[-1] // keys.shape[0]


def normal_all(keys: jax.Array, shape: tuple[int, ...], count: int, size: int) -> jax.Array:
    """Standard normal numbers (*shape, shards * count, size), each shard's from its own key."""
    noise = jax.vmap(lambda key: jax.random.normal(key, (*shape, count, size)))(keys)
    return jnp.moveaxis(noise, 0, len(shape)).reshape(*shape, -1, size)


def split_keys(keys: jax.Array, count: int) -> tuple[jax.Array, ...]:
    """``count`` new arrays of keys (shards,) from one."""
    return tuple(jnp.moveaxis(jax.vmap(lambda key: jax.random.split(key, count))(keys), 1, 0))


def completed_parts(environment: Environment, before: Any, after: Any) -> jax.Array | None:
    """Parts of the task that a step completed (n,), of batched states; None if not reported."""
    if environment.completed is None:
        return None
    return jax.vmap(environment.completed, in_axes=-1)(before, after)


def where_done(done: jax.Array, fresh: Any, state: Any) -> Any:
    """``fresh`` where an episode is done, else ``state``; both batched along the last axis."""
    return jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, state)
