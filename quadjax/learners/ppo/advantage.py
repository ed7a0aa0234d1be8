"""Generalized advantage estimation (Schulman et al., 2016) with truncated episodes."""

import jax
import jax.numpy as jnp

from quadjax.core.gradients import Scalar


def advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: Scalar,
    gae_lambda: Scalar,
) -> jax.Array:
    """Advantage of each step.

    ``delta_t = r_t + discount (1 - terminated_t) V(s'_t) - V(s_t)``
    ``A_t = delta_t + discount lambda (1 - done_t) A_{t+1}``

    ``s'_t`` is the state after the step and before any reset, so that a truncated episode
    bootstraps from its own last observation; a terminated one does not bootstrap.

    Args:
        reward: (time, ...).
        value: (time, ...) of the observation before each step.
        next_value: (time, ...) of the observation after it.
        terminated: (time, ...) bool.
        truncated: (time, ...) bool.
        discount: ().
        gae_lambda: ().

    Returns:
        (time, ...).
    """
    not_terminated = 1.0 - terminated.astype(value.dtype)
    not_done = 1.0 - (terminated | truncated).astype(value.dtype)
    delta = reward + discount * not_terminated * next_value - value

    def backward(following: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple:
        delta_t, not_done_t = step
        advantage = delta_t + discount * gae_lambda * not_done_t * following
        return advantage, advantage

    start = jnp.zeros_like(value[0])
    result: jax.Array
    _, result = jax.lax.scan(backward, start, (delta, not_done), reverse=True)
    return result
