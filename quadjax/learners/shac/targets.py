"""Targets of the critic: returns of short trajectories."""

import jax
import jax.numpy as jnp

from quadjax.core.gradients import Scalar
from quadjax.learners.shac.rollout import Trajectory


def td_lambda_targets(trajectory: Trajectory, discount: Scalar, td_lambda: Scalar) -> jax.Array:
    """TD(lambda) targets (time, n) of the value of each observation (Xu et al., 2022, eq. 7).

    ``G_t = r_t + discount ((1 - lambda) V(s'_t) + lambda G_{t+1})``. At the horizon and where an
    episode is truncated, ``V(s'_t)`` alone takes the place of the mixture; where it is terminated,
    zero does.
    """

    def backward(following: jax.Array, step: Trajectory) -> tuple[jax.Array, jax.Array]:
        mixed = (1.0 - td_lambda) * step.next_value + td_lambda * following
        future = jnp.where(step.truncated, step.next_value, mixed)
        future = jnp.where(step.terminated, 0.0, future)
        target = step.reward + discount * future
        return target, target

    _, targets = jax.lax.scan(backward, trajectory.next_value[-1], trajectory, reverse=True)
    return targets
