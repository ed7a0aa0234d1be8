"""Short flights of the current policy, differentiable from action to reward."""

import functools

import chex
import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.environment import Environment
from quadjax.core.gradients import tame
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.state import where_done

Carry = tuple[object, jax.Array, jax.Array]  # states, the discount so far and the return so far


@struct.dataclass
class Flight:
    """Steps of all environments: time first, then environments; no gradient flows through it."""

    observation: jax.Array  # (time, n, observation_size)
    reward: jax.Array  # (time, n)
    next_value: jax.Array  # (time, n) of the observation after the step, before any reset
    terminated: jax.Array  # (time, n) bool
    truncated: jax.Array  # (time, n) bool


@struct.dataclass
class Bounds:
    """What keeps the backward pass in bounds."""

    decay: jax.Array  # of the state's gradient per step
    limit: jax.Array  # largest entry of it, per environment, in units of the scaled return


def fly(
    environment: Environment,
    networks: Networks,
    environment_params: object,
    params: ActorCritic,
    target: ActorCritic,
    state: object,
    fresh: object,
    noise: jax.Array,
    discount: jax.Array,
    bounds: Bounds,
) -> tuple[jax.Array, tuple[object, Flight]]:
    """Discounted return of every environment over a short horizon, with a value at its end.

    ``sum_t gamma^t r_t``, plus the target critic's value, discounted, where an episode is
    truncated and at the horizon; after an episode's end the discounting begins anew.

    Args:
        environment: three pure functions.
        networks: the policy and the value.
        environment_params: traced parameters of the environment.
        params: of the networks; the gradient with respect to the policy is what this is for.
        target: of the value that stands for all that comes after.
        state: environment states, batched along the last axis.
        fresh: the states that a finished episode starts anew from.
        noise: (time, n, actions) to add to the mean action.
        discount: ().
        bounds: of the backward pass.

    Returns:
        The return summed over all environments, (), and the states after the last step with the
        flight.
    """
    chex.assert_tree_shape_suffix((state, fresh), noise.shape[1:2])

    settled = (environment, networks, environment_params, params, target, fresh, discount, bounds)
    one = functools.partial(_step, *settled)
    count = noise.shape[1]
    carry = (state, jnp.ones(count), jnp.zeros(count))
    (state, _, total), (flight, open_end) = jax.lax.scan(one, carry, noise)
    value = jnp.sum(total + open_end[-1])
    return value, jax.lax.stop_gradient((state, flight))


def _step(
    environment: Environment,
    networks: Networks,
    environment_params: object,
    params: ActorCritic,
    target: ActorCritic,
    fresh: object,
    discount: jax.Array,
    bounds: Bounds,
    carry: Carry,
    noise: jax.Array,
) -> tuple[Carry, tuple[Flight, jax.Array]]:
    """One step of all environments, and the value (n,) of what would come after it."""
    observe = jax.vmap(environment.observe, in_axes=(None, -1))
    step = jax.vmap(environment.step, in_axes=(None, -1, 0), out_axes=(-1, 0, 0, 0))
    state, gamma, total = carry
    state = tame(state, bounds.decay, bounds.limit)
    observation = observe(environment_params, state)
    mean = networks.mean(params, observation)
    following, reward, terminated, truncated = step(environment_params, state, mean + noise)
    ahead = networks.evaluate(target, observe(environment_params, following))
    ended = jnp.where(truncated, discount * ahead, 0.0)
    total = total + gamma * (reward + ended)
    done = terminated | truncated
    flight = Flight(observation, reward, ahead, terminated, truncated)
    gamma = jnp.where(done, 1.0, gamma * discount)
    open_end = jnp.where(done, 0.0, gamma * ahead)
    return (where_done(done, fresh, following), gamma, total), (flight, open_end)
