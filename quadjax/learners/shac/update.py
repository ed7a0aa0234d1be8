"""One SHAC update: a policy gradient through the simulator, then the critic."""

import dataclasses
import functools

import chex
import jax
import jax.numpy as jnp
import optax
from flax import struct

from quadjax.core.environment import Environment
from quadjax.learners.batches import shuffled, take_rows
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.shac.rollout import Bounds, Flight, fly
from quadjax.learners.shac.targets import td_lambda_targets
from quadjax.learners.state import (
    AXIS,
    Learner,
    Metrics,
    TrainState,
    clip_by_norm,
    count_lanes,
    episode_metrics,
    linear,
    normal_all,
    reset_all,
    select_finite,
    split_keys,
)

MEAN_PART = 20.0  # the running mean is over at most one part in so many of the updates so far


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
    final_discount: jax.Array
    state_gradient_decay: jax.Array
    state_gradient_clip: jax.Array
    std: jax.Array
    final_std: jax.Array
    reward_scale: jax.Array
    mean_rate: jax.Array  # of the running mean of the networks
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

    @property
    def lanes(self) -> int:
        """Equal shares of the environments, each with its own key."""
        return count_lanes(self.environments, 1, self.critic_batches, self.shares)


def make_learner(
    environment: Environment, networks: Networks, structure: Structure, hyper: Hyper
) -> Learner:
    """SHAC on a differentiable environment."""
    parts = (environment, networks, structure)
    return Learner(
        init=functools.partial(_init, *parts),
        update=functools.partial(_update, *parts),
        hyper=hyper,
        steps_per_update=structure.environments * structure.horizon,
        num_shards=structure.lanes,
    )


def _init(
    environment: Environment,
    networks: Networks,
    s: Structure,
    hyper: Hyper,
    environment_params: object,
    key: jax.Array,
) -> TrainState:
    network_key, reset_key, lane_key = jax.random.split(key, 3)
    params = networks.init(network_key)
    params = params.replace(log_std=jnp.full_like(params.log_std, jnp.log(hyper.std)))
    resets = jax.random.split(reset_key, s.lanes)
    count = s.environments // s.lanes
    adam = optax.scale_by_adam()
    return TrainState(
        params=params,
        optimiser=(adam.init(params.policy), adam.init(params.value)),
        target=jax.tree.map(jnp.copy, params),
        environment=reset_all(environment, environment_params, resets, count),
        keys=jax.random.split(lane_key, s.lanes),
        update=jnp.zeros((), jnp.int32),
        mean=jax.tree.map(jnp.copy, params),
    )


def _update(
    environment: Environment,
    networks: Networks,
    s: Structure,
    hyper: Hyper,
    environment_params: object,
    state: TrainState,
) -> tuple[TrainState, Metrics]:
    fraction = state.update.astype(jnp.float32) / s.updates
    keys, reset_keys, noise_keys, shuffle_keys = split_keys(state.keys, 4)
    count = s.environments // s.lanes
    fresh = reset_all(environment, environment_params, reset_keys, count)
    std = linear(hyper.std, hyper.final_std, fraction)
    hyper = hyper.replace(discount=linear(hyper.discount, hyper.final_discount, fraction))
    noise = std * normal_all(noise_keys, (s.horizon,), count, networks.action_size)
    scaled = _scale_reward(environment, hyper.reward_scale)
    policy, policy_adam, flown, flight, metrics = _actor(
        scaled, networks, s, hyper, environment_params, state, fresh, noise, fraction
    )
    value, value_adam, critic_metrics = _critic(
        networks, s, hyper, state, flight, shuffle_keys, fraction
    )
    log_std = jnp.full_like(state.params.log_std, jnp.log(std))
    params = ActorCritic(policy=policy, log_std=log_std, value=value)
    target = jax.tree.map(
        lambda old, new: old + hyper.critic_target_rate * (new - old), state.target, params
    )
    optimiser = (policy_adam, value_adam)
    mean = _mean(hyper, state, params)
    following = TrainState(params, optimiser, target, flown, keys, state.update + 1, mean)
    return following, metrics | critic_metrics | _watch(flight, hyper.reward_scale, std)


def _mean(hyper: Hyper, state: TrainState, params: ActorCritic) -> ActorCritic:
    """The running mean of all networks' parameters, over at most a part of the updates so far."""
    rate = jnp.maximum(hyper.mean_rate, MEAN_PART / (MEAN_PART + state.update))
    mean = jax.tree.map(lambda old, new: (1.0 - rate) * old + rate * new, state.mean, params)
    return mean.replace(log_std=params.log_std)


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
    """Ascend the return of a short flight."""
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
    policy, adam, metrics = _policy_step(hyper, state, gradient, fraction)
    return policy, adam, flown, flight, {"policy_loss": value} | metrics


def _policy_step(
    hyper: Hyper, state: TrainState, gradient: dict, fraction: jax.Array
) -> tuple[dict, optax.OptState, Metrics]:
    """One step against the loss's gradient.

    One that is not finite changes nothing. While the critic warms up the policy stands still, and
    Adam learns the gradient's size.
    """
    gradient, norm = clip_by_norm(gradient, hyper.gradient_norm)
    rate = linear(hyper.learning_rate, hyper.final_learning_rate, fraction)
    old = (state.params.policy, state.optimiser[0])
    new = _adam_step(hyper, rate, gradient, *old)
    fine = jnp.isfinite(norm)
    policy, adam = select_finite(fine, new, old)
    policy = select_finite(state.update >= hyper.warm_up, policy, old[0])
    metrics = {
        "gradient_norm": norm,
        "skipped": 1.0 - fine.astype(norm.dtype),
        "learning_rate": rate,
    }
    return policy, adam, metrics


def _adam_step(
    hyper: Hyper, rate: jax.Array, gradient: dict, params: dict, adam: optax.OptState
) -> tuple[dict, optax.OptState]:
    transform = optax.scale_by_adam(b1=hyper.adam_b1, b2=hyper.adam_b2)
    direction, adam = transform.update(gradient, adam)
    return jax.tree.map(lambda p, d: p - rate * d, params, direction), adam


def _critic(
    networks: Networks,
    s: Structure,
    hyper: Hyper,
    state: TrainState,
    flight: Flight,
    keys: jax.Array,
    fraction: jax.Array,
) -> tuple[dict, optax.OptState, Metrics]:
    """Several passes over the flight towards its TD(lambda) targets."""
    rate = linear(
        hyper.critic_learning_rate,
        hyper.critic_learning_rate * hyper.final_learning_rate / hyper.learning_rate,
        fraction,
    )
    targets = td_lambda_targets(flight, hyper.discount, hyper.td_lambda)
    rows = _lay_out((flight.observation, targets), keys.shape[0])
    count = rows[0].shape[1]

    def one_batch(carry: tuple, chosen: jax.Array) -> tuple[tuple, jax.Array]:
        observation, target = (take_rows(x, chosen) for x in rows)
        return _critic_step(networks, hyper, rate, state.params, carry, observation, target)

    def one_pass(carry: tuple, keys: jax.Array) -> tuple[tuple, jax.Array]:
        return jax.lax.scan(one_batch, carry, shuffled(keys, count, s.critic_batches))

    pass_keys = jnp.stack(split_keys(keys, s.critic_passes))
    carry = (state.params.value, state.optimiser[1])
    (value, adam), errors = jax.lax.scan(one_pass, carry, pass_keys)
    centre = jax.lax.pmean(jnp.mean(targets), AXIS)
    variance = jax.lax.pmean(jnp.mean((targets - centre) ** 2), AXIS)
    explained = 1.0 - errors[-1].mean() / jnp.maximum(variance, 1e-9)
    return value, adam, {"value_loss": errors.mean(), "explained_variance": explained}


def _lay_out(flown: tuple[jax.Array, jax.Array], lanes: int) -> tuple[jax.Array, jax.Array]:
    """From (time, n, ..) to (lanes, n / lanes, time, ..): each environment's steps together."""

    def one(x: jax.Array) -> jax.Array:
        time, n = x.shape[:2]
        return jnp.moveaxis(x.reshape(time, lanes, n // lanes, *x.shape[2:]), 0, 2)

    return jax.tree.map(one, flown)


def _critic_step(
    networks: Networks,
    hyper: Hyper,
    rate: jax.Array,
    params: ActorCritic,
    carry: tuple[dict, optax.OptState],
    observation: jax.Array,
    target: jax.Array,
) -> tuple[tuple[dict, optax.OptState], jax.Array]:
    value, adam = carry
    chex.assert_equal_shape_prefix((observation, target), 1)

    def loss(value: dict) -> jax.Array:
        predicted = networks.evaluate(params.replace(value=value), observation)
        return jnp.mean((predicted - target) ** 2)

    error, gradient = jax.lax.pmean(jax.value_and_grad(loss)(value), AXIS)
    gradient, norm = clip_by_norm(gradient, hyper.critic_gradient_norm)
    new = _adam_step(hyper, rate, gradient, value, adam)
    return select_finite(jnp.isfinite(norm), new, carry), error


def _watch(flight: Flight, reward_scale: jax.Array, std: jax.Array) -> Metrics:
    """Scalars of the flight, over all devices."""
    metrics = episode_metrics(flight.reward, flight.terminated, flight.truncated)
    return metrics | {"reward": metrics["reward"] / reward_scale, "std": std}
