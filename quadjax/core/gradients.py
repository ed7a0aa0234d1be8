"""Functions with custom derivatives."""

from typing import TypeVar

import jax
import jax.numpy as jnp

Tree = TypeVar("Tree")
Scalar = jax.Array | float  # a number (): an array under a trace, or a Python float


@jax.custom_vjp
def clip_inward(value: jax.Array, low: Scalar, high: Scalar) -> jax.Array:
    """Clip to [low, high]; cotangents pass unless gradient descent would move further outside.

    The derivative of ``jnp.clip`` is zero outside [low, high], so that a saturated command gets no
    gradient. Here a clipped value gets the gradient that moves it inwards, and none that moves it
    outwards.
    """
    return jnp.clip(value, low, high)


def _clip_forward(value: jax.Array, low: Scalar, high: Scalar) -> tuple:
    return jnp.clip(value, low, high), (value, jnp.asarray(low), jnp.asarray(high))


def _clip_backward(residuals: tuple, cotangent: jax.Array) -> tuple:
    value, low, high = residuals
    outwards = ((value > high) & (cotangent < 0)) | ((value < low) & (cotangent > 0))
    return jnp.where(outwards, 0.0, cotangent), jnp.zeros_like(low), jnp.zeros_like(high)


clip_inward.defvjp(_clip_forward, _clip_backward)


@jax.custom_vjp
def scale_and_clip_cotangent(tree: Tree, decay: Scalar, limit: Scalar) -> Tree:
    """The identity; in the backward pass every cotangent is scaled, clipped and made finite.

    ``g -> clip(decay g, -limit, limit)``, and 0 where ``g`` is not finite.

    Args:
        tree: any pytree; leaves that are not floating-point numbers pass.
        decay: () factor on every cotangent.
        limit: () largest magnitude of an entry afterwards.
    """
    return tree


def _scale_forward(tree: Tree, decay: Scalar, limit: Scalar) -> tuple:
    return tree, (decay, limit)


def _scale_backward(residuals: tuple, cotangent: Tree) -> tuple:
    decay, limit = residuals

    def one(g: jax.Array) -> jax.Array:
        if not jnp.issubdtype(g.dtype, jnp.inexact):
            return g
        return jnp.clip(jnp.where(jnp.isfinite(g), decay * g, 0.0), -limit, limit)

    return jax.tree.map(one, cotangent), jnp.zeros_like(decay), jnp.zeros_like(limit)


scale_and_clip_cotangent.defvjp(_scale_forward, _scale_backward)


@jax.custom_jvp
def bounded_sqrt(value: jax.Array, floor: float) -> jax.Array:
    """``sqrt(max(value, 0))`` with a bounded derivative, ``1 / (2 max(sqrt, floor))``."""
    return jnp.sqrt(jnp.maximum(value, 0.0))


@bounded_sqrt.defjvp
def _bounded_sqrt_jvp(primals: tuple, tangents: tuple) -> tuple[jax.Array, jax.Array]:
    root = bounded_sqrt(*primals)
    return root, tangents[0] / (2.0 * jnp.maximum(root, primals[1]))
