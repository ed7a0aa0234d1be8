"""One SHAC update: a policy gradient through the simulator, then the critic."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax

from quadjax.core.environment import Environment
from quadjax.core.gradients import Scalar
from quadjax.core.traced import as_leaves, register
from quadjax.learners.metrics import episode_metrics
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.shac.actor import collect_gradient, policy_step
from quadjax.learners.shac.critic import fit_critic
from quadjax.learners.shac.hyperparameters import SHAC
from quadjax.learners.shac.rollout import Trajectory
from quadjax.learners.shac.targets import td_lambda_targets
from quadjax.learners.shards import (
    count_shards,
    envs_per_shard,
    normal_all,
    reset_all,
    split_keys,
)
from quadjax.learners.state import Learner, Metrics, TrainState

EMA_FRACTION = 20.0  # the moving average covers about one part in 20 of the updates so far

register(SHAC)


def make_learner(
    environment: Environment, networks: Networks, hyper: SHAC, max_shards: int = 8
) -> Learner:
    """SHAC on a differentiable environment; arguments as of ``SHAC.make``."""
    shards = count_shards(hyper.num_envs, 1, hyper.critic_minibatches, max_shards)
    return Learner(
        init=functools.partial(_init, environment, networks, shards),
        update=functools.partial(_update, environment, networks),
        hyper=as_leaves(hyper),
        steps_per_update=hyper.num_envs * hyper.horizon,
        num_shards=shards,
    )


def _init(
    environment: Environment,
    networks: Networks,
    shards: int,
    hyper: SHAC,
    environment_params: Any,
    key: jax.Array,
) -> TrainState:
    network_key, reset_key, shard_key = jax.random.split(key, 3)
    params = networks.init(network_key)
    params = dataclasses.replace(params, log_std=jnp.full_like(params.log_std, jnp.log(hyper.std)))
    resets = jax.random.split(reset_key, shards)
    count = hyper.num_envs // shards
    adam = optax.scale_by_adam()
    return TrainState(
        params=params,
        optimizer=(adam.init(params.policy), adam.init(params.value)),
        target=jax.tree.map(jnp.copy, params),
        environment=reset_all(environment, environment_params, resets, count),
        keys=jax.random.split(shard_key, shards),
        update=jnp.zeros((), jnp.int32),
        ema=jax.tree.map(jnp.copy, params),
    )


def _update(
    environment: Environment,
    networks: Networks,
    hyper: SHAC,
    environment_params: Any,
    state: TrainState,
) -> tuple[TrainState, Metrics]:
    keys, reset_keys, noise_keys, shuffle_keys = split_keys(state.keys, 4)
    count = envs_per_shard(state.environment, keys)
    fresh = reset_all(environment, environment_params, reset_keys, count)
    noise = hyper.std * normal_all(noise_keys, (hyper.horizon,), count, networks.action_size)
    loss, gradient, environment_state, trajectory = collect_gradient(
        environment, networks, hyper, environment_params, state, fresh, noise
    )
    targets = td_lambda_targets(trajectory, hyper.discount, hyper.td_lambda)
    policy, policy_optimizer, policy_metrics = policy_step(hyper, state, gradient)
    value, value_optimizer, critic_metrics = fit_critic(
        networks, hyper, state, trajectory.observation, targets, shuffle_keys
    )
    log_std = jnp.full_like(state.params.log_std, jnp.log(hyper.std))
    params = ActorCritic(policy=policy, log_std=log_std, value=value)
    following = dataclasses.replace(
        state,
        params=params,
        optimizer=(policy_optimizer, value_optimizer),
        target=_move(state.target, params, hyper.target_update_rate),
        environment=environment_state,
        keys=keys,
        update=state.update + 1,
        ema=_moving_average(hyper, state, params),
    )
    metrics = {"policy_loss": loss} | policy_metrics | critic_metrics
    return following, metrics | _rollout_metrics(trajectory, hyper)


def _move(old: ActorCritic, new: ActorCritic, rate: Scalar) -> ActorCritic:
    """``old + rate (new - old)``: the target critic follows the critic."""
    return jax.tree.map(lambda a, b: a + rate * (b - a), old, new)


def _moving_average(hyper: SHAC, state: TrainState, params: ActorCritic) -> ActorCritic:
    """The exponential moving average of the parameters.

    ``(1 - rate) ema + rate params`` with ``rate = max(ema_rate, 20 / (20 + updates))``: the average
    covers about a twentieth of the updates so far, or less, so that early parameters fade.
    (``optax.incremental_update`` adds in the other order, which rounds differently.)
    """
    rate = jnp.maximum(hyper.ema_rate, EMA_FRACTION / (EMA_FRACTION + state.update))
    ema = jax.tree.map(lambda old, new: (1.0 - rate) * old + rate * new, state.ema, params)
    return dataclasses.replace(ema, log_std=params.log_std)


def _rollout_metrics(trajectory: Trajectory, hyper: SHAC) -> Metrics:
    metrics = episode_metrics(
        trajectory.reward, trajectory.terminated, trajectory.truncated, trajectory.completed
    )
    reward = metrics["reward"] / hyper.reward_scale
    return metrics | {"reward": reward, "std": jnp.asarray(hyper.std)}
