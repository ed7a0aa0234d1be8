"""Short rollouts of the current policy, differentiable from actions to rewards."""

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.environment import Environment
from quadjax.core.gradients import scale_and_clip_cotangent
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.shac.hyperparameters import SHAC
from quadjax.learners.shards import completed_parts, where_done

Carry = tuple[Any, jax.Array, jax.Array]  # environment states, discount so far, return so far


@struct.dataclass
class Trajectory:
    """Steps of all environments: time first, then environments. No gradient flows through it."""

    observation: jax.Array  # (time, n, observation_size)
    reward: jax.Array  # (time, n), scaled
    next_value: jax.Array  # (time, n) of the observation after the step, before any reset
    terminated: jax.Array  # (time, n) bool
    truncated: jax.Array  # (time, n) bool
    completed: jax.Array | None = None  # (time, n), where the environment reports it


def rollout_return(
    environment: Environment,
    networks: Networks,
    hyper: SHAC,
    environment_params: Any,
    params: ActorCritic,
    target: ActorCritic,
    state: Any,
    fresh: Any,
    noise: jax.Array,
) -> tuple[jax.Array, tuple[Any, Trajectory]]:
    """Discounted return of every environment over a short horizon, with a value at its end.

    ``sum_t gamma^t r_t``, plus the discounted value of the target critic where an episode is
    truncated and at the horizon (Xu et al., 2022, eq. 5). After the end of an episode the
    discounting restarts at 1.

    Args:
        environment: three pure functions of one agent, differentiable.
        networks: the policy and the value.
        hyper: discount, reward scale, and the decay and clip of the state's cotangent.
        environment_params: traced parameters of the environment.
        params: of the networks; the gradient is taken with respect to the policy's.
        target: parameters of the target critic.
        state: environment states, batched along the last axis.
        fresh: the states that an ended episode restarts from.
        noise: (time, n, actions) to add to the mean action.

    Returns:
        The return summed over all environments, (), and the states after the last step with the
        trajectory.
    """
    chex.assert_tree_shape_suffix((state, fresh), noise.shape[1:2])
    count = noise.shape[1]
    step = functools.partial(
        _step, environment, networks, hyper, environment_params, params, target, fresh
    )
    carry = (state, jnp.ones(count), jnp.zeros(count))
    (state, _, total), (trajectory, open_end) = jax.lax.scan(step, carry, noise)
    value = jnp.sum(total + open_end[-1])
    return value, jax.lax.stop_gradient((state, trajectory))


def _step(
    environment: Environment,
    networks: Networks,
    hyper: SHAC,
    environment_params: Any,
    params: ActorCritic,
    target: ActorCritic,
    fresh: Any,
    carry: Carry,
    noise: jax.Array,
) -> tuple[Carry, tuple[Trajectory, jax.Array]]:
    """One step of all environments, and the discounted value (n,) of what follows it."""
    observe = jax.vmap(environment.observe, in_axes=(None, -1))
    step = jax.vmap(environment.step, in_axes=(None, -1, 0), out_axes=(-1, 0, 0, 0))
    state, gamma, total = carry
    state = scale_and_clip_cotangent(state, hyper.cotangent_decay, hyper.cotangent_clip)
    observation = observe(environment_params, state)
    mean = networks.mean(params, observation)
    following, reward, terminated, truncated = step(environment_params, state, mean + noise)
    reward = hyper.reward_scale * reward
    next_value = networks.value(target, observe(environment_params, following))
    bootstrap = jnp.where(truncated, hyper.discount * next_value, 0.0)
    total = total + gamma * (reward + bootstrap)
    done = terminated | truncated
    trajectory = Trajectory(
        observation,
        reward,
        next_value,
        terminated,
        truncated,
        completed_parts(environment, state, following),
    )
    gamma = jnp.where(done, 1.0, gamma * hyper.discount)
    open_end = jnp.where(done, 0.0, gamma * next_value)
    return (where_done(done, fresh, following), gamma, total), (trajectory, open_end)
