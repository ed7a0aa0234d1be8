"""One SHAC update: a policy gradient through the simulator, then the critic."""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from flax import struct

from quadjax.environment import Environment
from quadjax.learn.networks import ActorCritic, Networks
from quadjax.learn.shac.flight import Bounds, Flight, fly
from quadjax.learn.state import (
    AXIS,
    Learner,
    Metrics,
    TrainState,
    clip_by_norm,
    count_lanes,
    linear,
    normal_all,
    reset_all,
    select_finite,
    split_keys,
)


@struct.dataclass
class Hyper:
    """Float hyperparameters: leaves, so that a sweep can batch them."""

    learning_rate: jax.Array
    final_learning_rate: jax.Array
    adam_b1: jax.Array
    adam_b2: jax.Array
    gradient_norm: jax.Array
    critic_learning_rate: jax.Array
    critic_gradient_norm: jax.Array
    critic_target_rate: jax.Array
    td_lambda: jax.Array
    discount: jax.Array
    state_gradient_decay: jax.Array
    state_gradient_clip: jax.Array
    std: jax.Array
    final_std: jax.Array
    reward_scale: jax.Array
    warm_up: jax.Array  # updates of the critic alone


@dataclasses.dataclass(frozen=True)
class Structure:
    """What fixes shapes and code."""

    environments: int
    horizon: int  # steps of each environment per update
    critic_passes: int
    critic_batches: int
    updates: int  # in the whole run: the schedules' length
    shares: int = 8  # of the environments, at most: a power of two


def make_learner(
    environment: Environment, networks: Networks, structure: Structure, hyper: Hyper
) -> Learner:
    """SHAC on a differentiable environment."""
    s = structure
    lanes = count_lanes(s.environments, 1, s.critic_batches, s.shares)

    def init(environment_params: object, key: jax.Array) -> TrainState:
        network_key, reset_key, lane_key = jax.random.split(key, 3)
        params = networks.init(network_key)
        params = params.replace(log_std=jnp.full_like(params.log_std, jnp.log(hyper.std)))
        resets = jax.random.split(reset_key, lanes)
        adam = optax.scale_by_adam()
        return TrainState(
            params=params,
            optimiser=(adam.init(params.policy), adam.init(params.value)),
            target=jax.tree.map(jnp.copy, params),
            environment=reset_all(environment, environment_params, resets, s.environments // lanes),
            keys=jax.random.split(lane_key, lanes),
            update=jnp.zeros((), jnp.int32),
        )

    def update(
        hyper: Hyper, environment_params: object, state: TrainState
    ) -> tuple[TrainState, Metrics]:
        fraction = state.update.astype(jnp.float32) / s.updates
        keys, reset_keys, noise_keys, shuffle_keys = split_keys(state.keys, 4)
        count = s.environments // lanes
        fresh = reset_all(environment, environment_params, reset_keys, count)
        std = linear(hyper.std, hyper.final_std, fraction)
        noise = std * normal_all(noise_keys, (s.horizon,), count, networks.action_size)
        scaled = _scale_reward(environment, hyper.reward_scale)
        policy, policy_adam, flown, flight, metrics = _actor(
            scaled, networks, s, hyper, environment_params, state, fresh, noise, fraction
        )
        rate = linear(
            hyper.critic_learning_rate,
            hyper.critic_learning_rate * hyper.final_learning_rate / hyper.learning_rate,
            fraction,
        )
        value, value_adam, critic_metrics = _critic(
            networks, s, hyper, state, flight, shuffle_keys, rate
        )
        log_std = jnp.full_like(state.params.log_std, jnp.log(std))
        params = ActorCritic(policy=policy, log_std=log_std, value=value)
        target = jax.tree.map(
            lambda old, new: old + hyper.critic_target_rate * (new - old), state.target, params
        )
        following = TrainState(
            params=params,
            optimiser=(policy_adam, value_adam),
            target=target,
            environment=flown,
            keys=keys,
            update=state.update + 1,
        )
        return following, metrics | critic_metrics | _watch(flight, hyper.reward_scale, std)

    return Learner(init, update, hyper, s.environments * s.horizon, lanes)


def _scale_reward(environment: Environment, scale: jax.Array) -> Environment:
    def step(params: object, state: object, action: jax.Array) -> tuple:
        following, reward, terminated, truncated = environment.step(params, state, action)
        return following, scale * reward, terminated, truncated

    return dataclasses.replace(environment, step=step)


def _actor(
    environment: Environment,
    networks: Networks,
    s: Structure,
    hyper: Hyper,
    environment_params: object,
    state: TrainState,
    fresh: object,
    noise: jax.Array,
    fraction: jax.Array,
) -> tuple[dict, optax.OptState, object, Flight, Metrics]:
    """Ascend the return of a short flight.

    A gradient that is not finite changes nothing; nor does one while the critic warms up.
    """
    bounds = Bounds(hyper.state_gradient_decay, hyper.state_gradient_clip)

    def loss(policy: dict) -> tuple[jax.Array, tuple[object, Flight]]:
        value, flown = fly(
            environment,
            networks,
            environment_params,
            state.params.replace(policy=policy),
            state.target,
            state.environment,
            fresh,
            noise,
            hyper.discount,
            bounds,
        )
        return -value, flown

    (value, (flown, flight)), gradient = jax.value_and_grad(loss, has_aux=True)(state.params.policy)
    share = 1.0 / (s.environments * s.horizon)
    value, gradient = jax.lax.psum(jax.tree.map(lambda x: x * share, (value, gradient)), AXIS)
    gradient, norm = clip_by_norm(gradient, hyper.gradient_norm)
    rate = linear(hyper.learning_rate, hyper.final_learning_rate, fraction)
    policy, adam = _adam_step(hyper, rate, gradient, state.params.policy, state.optimiser[0])
    fine = jnp.isfinite(norm)
    moves = fine & (state.update >= hyper.warm_up)
    policy, adam = select_finite(moves, (policy, adam), (state.params.policy, state.optimiser[0]))
    metrics = {
        "policy_loss": value,
        "gradient_norm": norm,
        "skipped": 1.0 - fine.astype(norm.dtype),
        "learning_rate": rate,
    }
    return policy, adam, flown, flight, metrics


def _adam_step(
    hyper: Hyper, rate: jax.Array, gradient: dict, params: dict, adam: optax.OptState
) -> tuple[dict, optax.OptState]:
    transform = optax.scale_by_adam(b1=hyper.adam_b1, b2=hyper.adam_b2)
    direction, adam = transform.update(gradient, adam)
    return jax.tree.map(lambda p, d: p - rate * d, params, direction), adam


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


def _rows(lanes: jax.Array, chosen: jax.Array) -> jax.Array:
    """The chosen environments of every lane as one flat batch of rows."""
    taken = jax.vmap(lambda lane, i: lane[i])(lanes, chosen)
    return taken.reshape(-1, *lanes.shape[3:])


def _critic(
    networks: Networks,
    s: Structure,
    hyper: Hyper,
    state: TrainState,
    flight: Flight,
    keys: jax.Array,
    rate: jax.Array,
) -> tuple[dict, optax.OptState, Metrics]:
    """Several passes over the flight towards its TD(lambda) targets."""
    lanes = keys.shape[0]
    targets = td_lambda_targets(flight, hyper.discount, hyper.td_lambda)

    def lay_out(x: jax.Array) -> jax.Array:  # (time, n, ..) -> (lanes, n / lanes, time, ..)
        time, n = x.shape[:2]
        return jnp.moveaxis(x.reshape(time, lanes, n // lanes, *x.shape[2:]), 0, 2)

    rows = jax.tree.map(lay_out, (flight.observation, targets))

    def one_batch(carry: tuple, chosen: jax.Array) -> tuple[tuple, jax.Array]:
        value, adam = carry
        observation, target = (_rows(x, chosen) for x in rows)

        def loss(value: dict) -> jax.Array:
            predicted = networks.evaluate(state.params.replace(value=value), observation)
            return jnp.mean((predicted - target) ** 2)

        error, gradient = jax.lax.pmean(jax.value_and_grad(loss)(value), AXIS)
        gradient, norm = clip_by_norm(gradient, hyper.critic_gradient_norm)
        new = _adam_step(hyper, rate, gradient, value, adam)
        return select_finite(jnp.isfinite(norm), new, carry), error

    def one_pass(carry: tuple, keys: jax.Array) -> tuple[tuple, jax.Array]:
        order = jax.vmap(lambda key: jax.random.permutation(key, rows[0].shape[1]))(keys)
        order = jnp.moveaxis(order.reshape(lanes, s.critic_batches, -1), 1, 0)
        return jax.lax.scan(one_batch, carry, order)

    pass_keys = jnp.stack(split_keys(keys, s.critic_passes))
    carry = (state.params.value, state.optimiser[1])
    (value, adam), errors = jax.lax.scan(one_pass, carry, pass_keys)
    centre = jax.lax.pmean(jnp.mean(targets), AXIS)
    variance = jax.lax.pmean(jnp.mean((targets - centre) ** 2), AXIS)
    explained = 1.0 - errors[-1].mean() / jnp.maximum(variance, 1e-9)
    return value, adam, {"value_loss": errors.mean(), "explained_variance": explained}


def _watch(flight: Flight, reward_scale: jax.Array, std: jax.Array) -> Metrics:
    """Scalars of the flight, over all devices."""

    def mean(x: jax.Array) -> jax.Array:
        return jax.lax.pmean(jnp.mean(x.astype(jnp.float32)), AXIS)

    terminated, truncated = mean(flight.terminated), mean(flight.truncated)
    return {
        "reward": mean(flight.reward) / reward_scale,
        "crash_rate": terminated / jnp.maximum(terminated + truncated, 1e-9),
        "terminated": terminated,
        "std": std,
    }
