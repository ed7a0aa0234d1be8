"""Generalised advantage estimation (Schulman et al., 2016) that knows truncation."""

import jax
import jax.numpy as jnp


def advantages(
    reward: jax.Array,
    value: jax.Array,
    next_value: jax.Array,
    terminated: jax.Array,
    truncated: jax.Array,
    discount: jax.Array,
    gae_lambda: jax.Array,
) -> jax.Array:
    """Advantage of each step.

    ``delta_t = r_t + discount (1 - terminated_t) V(s'_t) - V(s_t)`` with ``s'_t`` the state after
    the step and before any reset, so that a truncated episode bootstraps and a terminated one does
    not; ``A_t = delta_t + discount lambda (1 - done_t) A_{t+1}``.

    Args:
        reward: (time, ..).
        value: (time, ..) of the observation before each step.
        next_value: (time, ..) of the observation after it.
        terminated: (time, ..) bool.
        truncated: (time, ..) bool.
        discount: ().
        gae_lambda: ().

    Returns:
        (time, ..).
    """
    alive = 1.0 - terminated.astype(value.dtype)
    going_on = 1.0 - (terminated | truncated).astype(value.dtype)
    delta = reward + discount * alive * next_value - value

    def back(following: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple:
        delta_t, going_on_t = step
        advantage = delta_t + discount * gae_lambda * going_on_t * following
        return advantage, advantage

    _, result = jax.lax.scan(back, jnp.zeros_like(value[0]), (delta, going_on), reverse=True)
    return result
