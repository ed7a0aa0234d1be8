"""One PPO update: collect a rollout, estimate advantages, take gradient steps on minibatches."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import optax

from quadjax.core.environment import Environment
from quadjax.core.traced import as_leaves, register
from quadjax.learners.metrics import episode_metrics, explained_variance, global_mean
from quadjax.learners.minibatches import shuffled, take_rows, to_blocks
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.optimization import clip_by_norm, descend, select
from quadjax.learners.ppo.advantage import advantages
from quadjax.learners.ppo.hyperparameters import PPO
from quadjax.learners.ppo.loss import Batch, loss
from quadjax.learners.ppo.rollout import Rollout, collect
from quadjax.learners.shards import count_shards, reset_all, split_keys
from quadjax.learners.state import AXIS, Learner, Metrics, TrainState

Carry = tuple[ActorCritic, optax.OptState]

register(PPO)


def make_learner(
    environment: Environment, networks: Networks, hyper: PPO, max_shards: int = 8
) -> Learner:
    """PPO on an environment; arguments as of ``PPO.make``."""
    blocks = hyper.rollout_length // _block_length(hyper)
    shards = count_shards(hyper.num_envs, blocks, hyper.num_minibatches, max_shards)
    return Learner(
        init=functools.partial(_init, environment, networks, shards),
        update=functools.partial(_update, environment, networks),
        hyper=as_leaves(hyper),
        steps_per_update=hyper.num_envs * hyper.rollout_length,
        num_shards=shards,
    )


def _block_length(hyper: PPO) -> int:
    return hyper.shuffle_block or hyper.rollout_length


def _init(
    environment: Environment,
    networks: Networks,
    shards: int,
    hyper: PPO,
    environment_params: Any,
    key: jax.Array,
) -> TrainState:
    network_key, reset_key, shard_key = jax.random.split(key, 3)
    params = networks.init(network_key)
    params = dataclasses.replace(
        params, log_std=jnp.full_like(params.log_std, hyper.initial_log_std)
    )
    resets = jax.random.split(reset_key, shards)
    count = hyper.num_envs // shards
    return TrainState(
        params=params,
        optimizer=optax.scale_by_adam().init(params),
        target=None,
        environment=reset_all(environment, environment_params, resets, count),
        keys=jax.random.split(shard_key, shards),
        update=jnp.zeros((), jnp.int32),
    )


def _update(
    environment: Environment,
    networks: Networks,
    hyper: PPO,
    environment_params: Any,
    state: TrainState,
) -> tuple[TrainState, Metrics]:
    keys, rollout_keys, shuffle_keys = split_keys(state.keys, 3)
    environment_state, rollout = collect(
        environment,
        networks,
        environment_params,
        state.params,
        state.environment,
        rollout_keys,
        hyper.rollout_length,
    )
    batch = _make_batch(rollout, hyper)
    params, optimizer, metrics = _optimize(networks, hyper, state, batch, shuffle_keys)
    metrics |= _rollout_metrics(rollout, batch, state.params)
    following = dataclasses.replace(
        state,
        params=params,
        optimizer=optimizer,
        environment=environment_state,
        keys=keys,
        update=state.update + 1,
    )
    return following, metrics


def _make_batch(rollout: Rollout, hyper: PPO) -> Batch:
    """The rollout with advantages and value targets, ``G = A + V``."""
    advantage = advantages(
        rollout.reward * hyper.reward_scale,
        rollout.value,
        rollout.next_value,
        rollout.terminated,
        rollout.truncated,
        hyper.discount,
        hyper.gae_lambda,
    )
    return Batch(
        observation=rollout.observation,
        action=rollout.action,
        log_prob=rollout.log_prob,
        advantage=advantage,
        target=advantage + rollout.value,
    )


def _optimize(
    networks: Networks, hyper: PPO, state: TrainState, batch: Batch, keys: jax.Array
) -> tuple[ActorCritic, optax.OptState, Metrics]:
    """All epochs of all minibatches.

    A minibatch whose KL divergence is above the limit or whose gradient is not finite changes
    nothing.
    """
    blocks = to_blocks(batch, keys.shape[0], _block_length(hyper))
    count = blocks.advantage.shape[1]

    def minibatch(carry: Carry, chosen: jax.Array) -> tuple[Carry, Metrics]:
        return _gradient_step(networks, hyper, state.update, carry, take_rows(blocks, chosen))

    def epoch(carry: Carry, keys: jax.Array) -> tuple[Carry, Metrics]:
        return jax.lax.scan(minibatch, carry, shuffled(keys, count, hyper.num_minibatches))

    epoch_keys = jnp.stack(split_keys(keys, hyper.num_epochs))
    start = (state.params, state.optimizer)
    (params, optimizer), metrics = jax.lax.scan(epoch, start, epoch_keys)
    reduced = jax.tree.map(jnp.mean, metrics)
    reduced["kl_max"] = jnp.max(metrics["approx_kl"])
    reduced["learning_rate"] = jnp.asarray(hyper.learning_rate)
    return params, optimizer, reduced


def _gradient_step(
    networks: Networks, hyper: PPO, update: jax.Array, carry: Carry, batch: Batch
) -> tuple[Carry, Metrics]:
    """One step of Adam; while the critic warms up, the policy stays as it is."""
    params, optimizer = carry
    gradient, metrics = jax.grad(loss, has_aux=True)(params, networks, hyper, batch)
    gradient, metrics = jax.lax.pmean((gradient, metrics), AXIS)
    accepted = jnp.isfinite(optax.tree.norm(gradient))
    if hyper.max_kl is not None:
        accepted = (metrics["approx_kl"] <= hyper.max_kl) & accepted
    gradient, norm = _clip(gradient, hyper)
    direction, new_optimizer = optax.scale_by_adam(eps=hyper.adam_epsilon).update(
        gradient, optimizer
    )
    rate = jnp.asarray(hyper.learning_rate)
    policy_rate = jnp.where(update < hyper.critic_warmup, 0.0, rate)
    new_params = ActorCritic(
        policy=descend(params.policy, direction.policy, policy_rate),
        log_std=descend(params.log_std, direction.log_std, policy_rate),
        value=descend(params.value, direction.value, rate),
    )
    metrics |= {"gradient_norm": norm, "skipped": 1.0 - accepted.astype(norm.dtype)}
    return select(accepted, (new_params, new_optimizer), carry), metrics


def _clip(gradient: ActorCritic, hyper: PPO) -> tuple[ActorCritic, jax.Array]:
    """Clip by the global norm: of everything, or of policy and value separately.

    Returns:
        The clipped gradient, and the norm before: of everything, or of the policy.
    """
    if not hyper.separate_grad_clip:
        return clip_by_norm(gradient, hyper.max_grad_norm)
    actor, norm = clip_by_norm((gradient.policy, gradient.log_std), hyper.max_grad_norm)
    critic, _ = clip_by_norm(gradient.value, hyper.max_grad_norm)
    return ActorCritic(policy=actor[0], log_std=actor[1], value=critic), norm


def _rollout_metrics(rollout: Rollout, batch: Batch, params: ActorCritic) -> Metrics:
    error = global_mean((batch.target - rollout.value) ** 2)
    ended = rollout.terminated, rollout.truncated
    return episode_metrics(rollout.reward, *ended, rollout.completed) | {
        "explained_variance": explained_variance(error, batch.target),
        "std": jnp.mean(jnp.exp(params.log_std)),
    }
