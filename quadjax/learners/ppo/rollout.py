"""Flying the current policy and keeping what an update needs."""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.environment import Environment
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.state import normal_all, reset_all, split_keys, where_done

RESTART_BLOCK = 64  # longest time for which an environment's next start stays the same


@struct.dataclass
class Rollout:
    """Steps of all environments: time first, then environments."""

    observation: jax.Array  # (time, n, observation_size)
    action: jax.Array  # (time, n, actions) sampled, not clipped
    log_prob: jax.Array  # (time, n)
    value: jax.Array  # (time, n) of the observation
    next_value: jax.Array  # (time, n) of the observation after the step, before any reset
    reward: jax.Array  # (time, n)
    terminated: jax.Array  # (time, n) bool
    truncated: jax.Array  # (time, n) bool


def log_probability(action: jax.Array, mean: jax.Array, log_std: jax.Array) -> jax.Array:
    """Log density (..) of an action (.., k) under independent normals."""
    log_std = jnp.broadcast_to(log_std, action.shape)
    scaled = (action - mean) * jnp.exp(-log_std)
    return -0.5 * jnp.sum(scaled**2 + 2.0 * log_std + jnp.log(2.0 * jnp.pi), axis=-1)


def block_length(steps: int) -> int:
    """The longest divisor of ``steps`` that is at most ``RESTART_BLOCK``."""
    return max(d for d in range(1, min(steps, RESTART_BLOCK) + 1) if steps % d == 0)


def collect(
    environment: Environment,
    networks: Networks,
    environment_params: object,
    params: ActorCritic,
    state: object,
    keys: jax.Array,
    steps: int,
) -> tuple[object, Rollout]:
    """Fly ``steps`` steps of every environment.

    Each environment's next start is drawn once a block of at most ``RESTART_BLOCK`` steps rather
    than at every step, which would cost more than the physics.

    Args:
        environment: three pure functions.
        networks: the policy and the value.
        environment_params: traced parameters of the environment.
        params: of the networks.
        state: environment states, batched along the last axis.
        keys: (lanes,) PRNG keys.
        steps: of each environment.

    Returns:
        The environment states after the last step, reset where an episode ended, and the rollout.
    """
    length = block_length(steps)

    def block(carry: tuple, _: None) -> tuple[tuple, Rollout]:
        state, keys = carry
        keys, reset_keys, noise_keys = split_keys(keys, 3)
        count = jax.tree.leaves(state)[0].shape[-1] // keys.shape[0]
        fresh = reset_all(environment, environment_params, reset_keys, count)
        noise = normal_all(noise_keys, (length,), count, networks.action_size)

        def one(state: object, noise: jax.Array) -> tuple[object, Rollout]:
            return _step(environment, networks, environment_params, params, fresh, state, noise)

        state, rollout = jax.lax.scan(one, state, noise)
        return (state, keys), rollout

    (state, _), rollout = jax.lax.scan(block, (state, keys), None, steps // length)
    return state, jax.tree.map(lambda x: x.reshape(steps, *x.shape[2:]), rollout)


def _step(
    environment: Environment,
    networks: Networks,
    environment_params: object,
    params: ActorCritic,
    fresh: object,
    state: object,
    noise: jax.Array,
) -> tuple[object, Rollout]:
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
        value=networks.evaluate(params, observation),
        next_value=networks.evaluate(params, observe(environment_params, following)),
        reward=reward,
        terminated=terminated,
        truncated=truncated,
    )
    return where_done(terminated | truncated, fresh, following), rollout
