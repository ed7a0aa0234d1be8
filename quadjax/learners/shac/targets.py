"""What the critic learns from: the returns of short flights."""

import jax
import jax.numpy as jnp

from quadjax.learners.shac.rollout import Flight


def td_lambda_targets(flight: Flight, discount: jax.Array, td_lambda: jax.Array) -> jax.Array:
    """TD(lambda) targets (time, n) of the value of each observation.

    ``G_t = r_t + discount ((1 - lambda) V(s'_t) + lambda G_{t+1})``, with ``V(s'_t)`` alone at the
    horizon and where an episode is truncated, and nothing where it is terminated.
    """

    def back(following: jax.Array, step: Flight) -> tuple[jax.Array, jax.Array]:
        mixed = (1.0 - td_lambda) * step.next_value + td_lambda * following
        ahead = jnp.where(step.truncated, step.next_value, mixed)
        ahead = jnp.where(step.terminated, 0.0, ahead)
        target = step.reward + discount * ahead
        return target, target

    _, targets = jax.lax.scan(back, flight.next_value[-1], flight, reverse=True)
    return targets
