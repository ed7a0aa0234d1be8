"""Minibatches: blocks of consecutive steps, shuffled within each shard, as flat rows."""

from typing import Any

import chex
import jax
import jax.numpy as jnp


def to_blocks(tree: Any, shards: int, length: int) -> Any:
    """Steps of a rollout as blocks of consecutive steps of one environment.

    Args:
        tree: arrays (time, n, ...).
        shards: into which the n environments divide.
        length: of a block, a divisor of time.

    Returns:
        Arrays (shards, blocks, length, ...).
    """

    def one(x: jax.Array) -> jax.Array:
        time, n = x.shape[:2]
        x = x.reshape(time // length, length, shards, n // shards, *x.shape[2:])
        x = jnp.moveaxis(x, (2, 3), (0, 1))
        return x.reshape(shards, -1, length, *x.shape[4:])

    return jax.tree.map(one, tree)


def shuffled(keys: jax.Array, count: int, num_minibatches: int) -> jax.Array:
    """The blocks of each minibatch: indices (num_minibatches, shards, count / num_minibatches).

    Args:
        keys: (shards,) PRNG keys; each shard is shuffled within itself.
        count: blocks of a shard.
        num_minibatches: a divisor of ``count``.
    """
    order = jax.vmap(lambda key: jax.random.permutation(key, count))(keys)
    return jnp.moveaxis(order.reshape(keys.shape[0], num_minibatches, -1), 1, 0)


def take_rows(blocks: Any, chosen: jax.Array) -> Any:
    """The chosen blocks of every shard as one minibatch of rows.

    Args:
        blocks: arrays (shards, blocks, length, ...).
        chosen: (shards, k) indices of a shard's blocks.

    Returns:
        Arrays of rows (shards * k * length, ...).
    """

    def one(x: jax.Array) -> jax.Array:
        chex.assert_equal_shape_prefix((x, chosen), 1)
        taken = jax.vmap(lambda shard, i: shard[i])(x, chosen)
        return taken.reshape(-1, *x.shape[3:])

    return jax.tree.map(one, blocks)
