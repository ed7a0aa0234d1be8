"""Rollouts of the current policy, the data of a PPO update."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.environment import Environment
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.shards import (
    completed_parts,
    envs_per_shard,
    normal_all,
    reset_all,
    split_keys,
    where_done,
)

MAX_RESET_INTERVAL = 64  # steps between two draws of the states that episodes restart from


@struct.dataclass
class Rollout:
    """Steps of all environments: axes are time, environment, then the quantity's own."""

    observation: jax.Array  # (time, n, observation_size)
    action: jax.Array  # (time, n, actions), sampled, not clipped
    log_prob: jax.Array  # (time, n) of the action under the policy that sampled it
    value: jax.Array  # (time, n) of the observation
    next_value: jax.Array  # (time, n) of the observation after the step, before any reset
    reward: jax.Array  # (time, n)
    terminated: jax.Array  # (time, n) bool
    truncated: jax.Array  # (time, n) bool
    completed: jax.Array | None = None  # (time, n), where the environment reports it


def log_probability(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Log density (...) of an action (..., k) under independent normal distributions."""
    log_std = jnp.broadcast_to(log_std, action.shape)
    scaled = (action - mean) * jnp.exp(-log_std)
    return -0.5 * jnp.sum(scaled**2 + 2.0 * log_std + jnp.log(2.0 * jnp.pi), axis=-1)


def reset_interval(steps: int) -> int:
    """The longest divisor of ``steps`` that is at most ``MAX_RESET_INTERVAL``."""
    return max(d for d in range(1, min(steps, MAX_RESET_INTERVAL) + 1) if steps % d == 0)


def collect(
    environment: Environment,
    networks: Networks,
    environment_params: Any,
    params: ActorCritic,
    state: Any,
    keys: jax.Array,
    steps: int,
) -> tuple[Any, Rollout]:
    """Simulate ``steps`` steps of every environment with sampled actions.

    The state that an environment restarts from is drawn once per ``reset_interval``, because
    drawing it at every step takes longer than the simulation. An environment whose episode ends
    twice within an interval restarts from the same state.

    Args:
        environment: three pure functions of one agent.
        networks: the policy and the value.
        environment_params: traced parameters of the environment.
        params: parameters of the networks.
        state: environment states, batched along the last axis.
        keys: (shards,) PRNG keys.
        steps: of each environment.

    Returns:
        The environment states after the last step, reset where an episode ended, and the rollout.
    """
    length = reset_interval(steps)

    def interval(carry: tuple[Any, jax.Array], _: None) -> tuple[tuple[Any, jax.Array], Rollout]:
        state, keys = carry
        keys, reset_keys, noise_keys = split_keys(keys, 3)
        count = envs_per_shard(state, keys)
        fresh = reset_all(environment, environment_params, reset_keys, count)
        noise = normal_all(noise_keys, (length,), count, networks.action_size)

        def one(state: Any, noise: jax.Array) -> tuple[Any, Rollout]:
            return _step(environment, networks, environment_params, params, fresh, state, noise)

        state, rollout = jax.lax.scan(one, state, noise)
        return (state, keys), rollout

    (state, _), rollout = jax.lax.scan(interval, (state, keys), None, steps // length)
    return state, jax.tree.map(lambda x: x.reshape(steps, *x.shape[2:]), rollout)


def _step(
    environment: Environment,
    networks: Networks,
    environment_params: Any,
    params: ActorCritic,
    fresh: Any,
    state: Any,
    noise: jax.Array,
) -> tuple[Any, Rollout]:
    """One step of all environments; an ended episode restarts from ``fresh``."""
    observe = jax.vmap(environment.observe, in_axes=(None, -1))
    observation = observe(environment_params, state)
    mean = networks.mean(params, observation)
    action = mean + jnp.broadcast_to(jnp.exp(params.log_std), noise.shape) * noise
    step = jax.vmap(environment.step, in_axes=(None, -1, 0), out_axes=(-1, 0, 0, 0))
    following, reward, terminated, truncated = step(environment_params, state, action)
    rollout = Rollout(
        observation=observation,
        action=action,
        log_prob=log_probability(action, mean, params.log_std),
        value=networks.value(params, observation),
        next_value=networks.value(params, observe(environment_params, following)),
        reward=reward,
        terminated=terminated,
        truncated=truncated,
        completed=completed_parts(environment, state, following),
    )
    return where_done(terminated | truncated, fresh, following), rollout
