"""Batches of rows from what was flown: shuffled within each lane, flat for the matrix products."""

import chex
import jax
import jax.numpy as jnp


def shuffled(keys: jax.Array, count: int, batches: int) -> jax.Array:
    """Which pieces of each lane make up each batch: (batches, lanes, count / batches).

    Args:
        keys: (lanes,) PRNG keys: a lane shuffles within itself.
        count: pieces of a lane.
        batches: into which they divide.
    """
    order = jax.vmap(lambda key: jax.random.permutation(key, count))(keys)
    return jnp.moveaxis(order.reshape(keys.shape[0], batches, -1), 1, 0)


def take_rows(pieces: jax.Array, chosen: jax.Array) -> jax.Array:
    """The chosen pieces of every lane as one batch of rows.

    Args:
        pieces: (lanes, pieces, length, ..): each of so many consecutive rows.
        chosen: (lanes, k) indices of a lane's pieces.

    Returns:
        The rows (lanes * k * length, ..).
    """
    chex.assert_equal_shape_prefix((pieces, chosen), 1)
    taken = jax.vmap(lambda lane, i: lane[i])(pieces, chosen)
    return taken.reshape(-1, *pieces.shape[3:])
