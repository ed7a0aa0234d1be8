"""Operations that change only how a gradient flows back."""

import jax
import jax.numpy as jnp


@jax.custom_vjp
def clip_inward(value: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Clip to [low, high]; the gradient of a loss passes unless it pushes further out.

    A plain clip has no gradient outside, so that a saturated command could never learn to come
    back. Here descent may always move a clipped value inwards, and never further outwards.
    """
    return jnp.clip(value, low, high)


def _clip_forward(value: jax.Array, low: jax.Array, high: jax.Array) -> tuple:
    return jnp.clip(value, low, high), (value, jnp.asarray(low), jnp.asarray(high))


def _clip_backward(kept: tuple, cotangent: jax.Array) -> tuple:
    value, low, high = kept
    outwards = ((value > high) & (cotangent < 0)) | ((value < low) & (cotangent > 0))
    return jnp.where(outwards, 0.0, cotangent), jnp.zeros_like(low), jnp.zeros_like(high)


clip_inward.defvjp(_clip_forward, _clip_backward)


@jax.custom_vjp
def tame(tree: object, decay: jax.Array, limit: jax.Array) -> object:
    """The same values; on the way back each cotangent is decayed, bounded and made finite.

    Args:
        tree: any pytree; integer leaves pass.
        decay: () factor on every cotangent.
        limit: () largest magnitude of an entry afterwards.
    """
    return tree


def _tame_forward(tree: object, decay: jax.Array, limit: jax.Array) -> tuple:
    return tree, (decay, limit)


def _tame_backward(kept: tuple, cotangent: object) -> tuple:
    decay, limit = kept

    def one(g: jax.Array) -> jax.Array:
        if not jnp.issubdtype(g.dtype, jnp.inexact):
            return g
        return jnp.clip(jnp.where(jnp.isfinite(g), decay * g, 0.0), -limit, limit)

    return jax.tree.map(one, cotangent), jnp.zeros_like(decay), jnp.zeros_like(limit)


tame.defvjp(_tame_forward, _tame_backward)
