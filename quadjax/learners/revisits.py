"""Restarts from states of earlier episodes: a buffer of states, one for each environment."""

from typing import Any

import jax
import jax.numpy as jnp

from quadjax.core.gradients import Scalar
from quadjax.learners.shards import envs_per_shard, split_keys, where_done

KEPT = 1 / 8  # fraction of the states without a crash that replace a state of the buffer


def restarts(buffer: Any, fresh: Any, keys: jax.Array, fraction: Scalar) -> Any:
    """States to restart from: ``fresh`` ones, or with probability ``fraction`` buffered ones.

    Args:
        buffer: states of earlier episodes, batched along the last axis.
        fresh: random starts, likewise.
        keys: (shards,) PRNG keys; a shard takes states of its own part of the buffer.
        fraction: () of buffered states.
    """
    count = envs_per_shard(fresh, keys)
    place_keys, chance_keys = split_keys(keys, 2)
    places = jax.vmap(lambda key: jax.random.permutation(key, count))(place_keys)
    places = (places + count * jnp.arange(keys.shape[0])[:, None]).reshape(-1)
    chosen = jax.tree.map(lambda x: jnp.take(x, places, axis=-1), buffer)
    return where_done(_drawn(chance_keys, count, fraction), chosen, fresh)


def remember(buffer: Any, states: Any, survived: jax.Array, keys: jax.Array) -> Any:
    """The buffer with some of the states from which rollouts had no crash.

    Args:
        buffer: states, batched along the last axis.
        states: of the environments before a rollout, likewise.
        survived: (n,) bool, whether the rollout had no crash.
        keys: (shards,) PRNG keys.
    """
    chosen = _drawn(keys, envs_per_shard(states, keys), KEPT) & survived
    return where_done(chosen, states, buffer)


def _drawn(keys: jax.Array, count: int, chance: Scalar) -> jax.Array:
    """Whether each environment (n,) is drawn, with a probability."""
    drawn = jax.vmap(lambda key: jax.random.uniform(key, (count,)))(keys)
    return drawn.reshape(-1) < chance
