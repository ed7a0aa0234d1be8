"""Clipping by the global norm, and gradient steps that skip non-finite gradients."""

from typing import Any

import jax
import jax.numpy as jnp
import optax

from quadjax.core.gradients import Scalar


def clip_by_norm(tree: Any, limit: Scalar) -> tuple[Any, jax.Array]:
    """Scale a gradient to a global norm of at most ``limit``.

    ``g min(1, limit / |g|)``, as ``optax.clip_by_global_norm``, which does not return the norm.

    Args:
        tree: the gradient.
        limit: ().

    Returns:
        The scaled gradient, and the norm () before scaling.
    """
    norm = optax.tree.norm(tree)
    scale = jnp.minimum(1.0, limit / jnp.maximum(norm, 1e-12))
    return jax.tree.map(lambda g: g * scale, tree), norm


def select(condition: jax.Array, new: Any, old: Any) -> Any:
    """``new`` if ``condition`` () else ``old``, leaf by leaf."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def descend(params: Any, direction: Any, rate: Scalar) -> Any:
    """``params - rate * direction``, leaf by leaf."""
    return jax.tree.map(lambda p, d: p - rate * d, params, direction)
