"""Scalar metrics of an update, averaged over all devices."""

import chex
import jax
import jax.numpy as jnp

from quadjax.learners.state import AXIS, Metrics


def global_mean(x: jax.Array) -> jax.Array:
    """The mean () over all entries of ``x`` on all devices."""
    return jax.lax.pmean(jnp.mean(x.astype(jnp.float32)), AXIS)


def explained_variance(error: jax.Array, target: jax.Array) -> jax.Array:
    """``1 - error / Var(target)`` (): 1 for a perfect value function, 0 for a constant.

    Args:
        error: () mean squared error, over all devices.
        target: value targets, any shape.
    """
    center = jax.lax.pmean(jnp.mean(target), AXIS)
    variance = jax.lax.pmean(jnp.mean((target - center) ** 2), AXIS)
    return 1.0 - error / jnp.maximum(variance, 1e-9)


def episode_metrics(
    reward: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    completed: jax.Array | None = None,
) -> Metrics:
    """Metrics of all steps (time, n) of an update.

    Returns:
        ``reward``: mean per step; ``terminated``: fraction of steps that terminate an episode;
        ``crash_rate``: fraction of ended episodes that were terminated rather than truncated; where
        ``completed`` is given, ``pass_rate``: completed parts of the task, divided by the sum of
        these and crashes.
    """
    chex.assert_equal_shape((reward, terminated, truncated))
    terminated, truncated = global_mean(terminated), global_mean(truncated)
    own: Metrics = {}
    if completed is not None:
        parts = global_mean(completed)
        own["pass_rate"] = parts / jnp.maximum(parts + terminated, 1e-9)
    return own | {
        "reward": global_mean(reward),
        "crash_rate": terminated / jnp.maximum(terminated + truncated, 1e-9),
        "terminated": terminated,
    }
