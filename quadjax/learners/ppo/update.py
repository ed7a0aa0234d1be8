"""One PPO update: fly, estimate advantages, several epochs of batches."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import optax
from flax import struct

from quadjax.core.environment import Environment
from quadjax.learners.batches import shuffled, take_rows
from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.ppo.advantage import advantages
from quadjax.learners.ppo.loss import Batch, loss
from quadjax.learners.ppo.rollout import Rollout, collect
from quadjax.learners.state import (
    AXIS,
    Learner,
    Metrics,
    TrainState,
    clip_by_norm,
    count_lanes,
    episode_metrics,
    linear,
    mean_of_all,
    reset_all,
    select_finite,
    split_keys,
)


@struct.dataclass
class Hyper:
    """Float hyperparameters: leaves, so that a sweep can batch them."""

    learning_rate: jax.Array
    final_learning_rate: jax.Array
    adam_epsilon: jax.Array
    discount: jax.Array
    gae_lambda: jax.Array
    clip: jax.Array
    value_coefficient: jax.Array
    entropy_coefficient: jax.Array
    gradient_norm: jax.Array
    kl_limit: jax.Array
    reward_scale: jax.Array
    warm_up: jax.Array  # updates of the value alone


@dataclasses.dataclass(frozen=True)
class Structure:
    """What fixes shapes and code."""

    environments: int
    steps: int  # of each environment per update
    batches: int
    epochs: int
    updates: int  # in the whole run: the schedule's length
    shuffle_block: int = 0  # consecutive steps kept together; 0: all of an update
    separate_clip: bool = True  # clip the policy's and the value's gradients apart
    shares: int = 8  # of the environments, at most: a power of two

    @property
    def block(self) -> int:
        """Consecutive steps kept together when shuffling."""
        return self.shuffle_block or self.steps

    @property
    def lanes(self) -> int:
        """Equal shares of the environments, each with its own key."""
        blocks = self.steps // self.block
        return count_lanes(self.environments, blocks, self.batches, self.shares)


def make_learner(
    environment: Environment, networks: Networks, structure: Structure, hyper: Hyper
) -> Learner:
    """PPO on an environment."""
    parts = (environment, networks, structure)
    return Learner(
        init=functools.partial(_init, *parts),
        update=functools.partial(_update, *parts),
        hyper=hyper,
        steps_per_update=structure.environments * structure.steps,
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
    resets = jax.random.split(reset_key, s.lanes)
    count = s.environments // s.lanes
    return TrainState(
        params=params,
        optimiser=optax.scale_by_adam().init(params),
        target=None,
        environment=reset_all(environment, environment_params, resets, count),
        keys=jax.random.split(lane_key, s.lanes),
        update=jnp.zeros((), jnp.int32),
    )


def _update(
    environment: Environment,
    networks: Networks,
    s: Structure,
    hyper: Hyper,
    environment_params: object,
    state: TrainState,
) -> tuple[TrainState, Metrics]:
    keys, rollout_keys, shuffle_keys = split_keys(state.keys, 3)
    flown, rollout = collect(
        environment,
        networks,
        environment_params,
        state.params,
        state.environment,
        rollout_keys,
        s.steps,
    )
    batch = _batch(rollout, hyper)
    params, optimiser, metrics = _epochs(networks, s, hyper, state, batch, shuffle_keys)
    metrics |= _watch(rollout, batch, state.params)
    following = state.replace(
        params=params, optimiser=optimiser, environment=flown, keys=keys, update=state.update + 1
    )
    return following, metrics


def _batch(rollout: Rollout, hyper: Hyper) -> Batch:
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


def _lay_out(batch: Batch, s: Structure, lanes: int) -> Batch:
    """From (time, n, ..) to (lanes, pieces, block, ..): stretches of ``block`` steps."""

    def one(x: jax.Array) -> jax.Array:
        time, n = x.shape[:2]
        x = x.reshape(time // s.block, s.block, lanes, n // lanes, *x.shape[2:])
        x = jnp.moveaxis(x, (2, 3), (0, 1))
        return x.reshape(lanes, -1, s.block, *x.shape[4:])

    return jax.tree.map(one, batch)


def _epochs(
    networks: Networks,
    s: Structure,
    hyper: Hyper,
    state: TrainState,
    batch: Batch,
    keys: jax.Array,
) -> tuple[ActorCritic, optax.OptState, Metrics]:
    """All epochs of all batches.

    A batch whose KL is beyond the limit or whose gradient is not finite changes nothing.
    """
    fraction = state.update.astype(jnp.float32) / s.updates
    rate = linear(hyper.learning_rate, hyper.final_learning_rate, fraction)
    policy_rate = jnp.where(state.update < hyper.warm_up, 0.0, rate)
    rates = ActorCritic(policy=policy_rate, log_std=policy_rate, value=rate)
    epoch_keys = jnp.stack(split_keys(keys, s.epochs))

    pieces = _lay_out(batch, s, keys.shape[0])
    count = pieces.advantage.shape[1]

    def one_batch(carry: tuple, chosen: jax.Array) -> tuple[tuple, Metrics]:
        rows = jax.tree.map(lambda x: take_rows(x, chosen), pieces)
        return _gradient_step(networks, s, hyper, rates, carry, rows)

    def one_epoch(carry: tuple, keys: jax.Array) -> tuple[tuple, Metrics]:
        return jax.lax.scan(one_batch, carry, shuffled(keys, count, s.batches))

    (params, optimiser), metrics = jax.lax.scan(
        one_epoch, (state.params, state.optimiser), epoch_keys
    )
    reduced = jax.tree.map(jnp.mean, metrics)
    reduced["kl_max"] = jnp.max(metrics["approx_kl"])
    reduced["learning_rate"] = rate
    return params, optimiser, reduced


def _gradient_step(
    networks: Networks,
    s: Structure,
    hyper: Hyper,
    rates: ActorCritic,
    carry: tuple[ActorCritic, optax.OptState],
    batch: Batch,
) -> tuple[tuple[ActorCritic, optax.OptState], Metrics]:
    params, optimiser = carry
    gradient, metrics = jax.grad(loss, has_aux=True)(
        params,
        networks,
        batch,
        hyper.clip,
        hyper.value_coefficient,
        hyper.entropy_coefficient,
    )
    gradient, metrics = jax.lax.pmean((gradient, metrics), AXIS)
    finite = jnp.isfinite(optax.tree.norm(gradient))
    gradient, norm = _clip(gradient, hyper.gradient_norm, s.separate_clip)
    adam = optax.scale_by_adam(eps=hyper.adam_epsilon)
    direction, new_optimiser = adam.update(gradient, optimiser)
    new_params = jax.tree.map(
        lambda rate, part, d: jax.tree.map(lambda p, d: p - rate * d, part, d),
        rates,
        params,
        direction,
    )
    fine = (metrics["approx_kl"] <= hyper.kl_limit) & finite
    metrics |= {"gradient_norm": norm, "skipped": 1.0 - fine.astype(norm.dtype)}
    kept = select_finite(fine, (new_params, new_optimiser), carry)
    return kept, metrics


def _clip(gradient: ActorCritic, limit: jax.Array, apart: bool) -> tuple[ActorCritic, jax.Array]:
    """Clip by the global norm: of all, or of the policy's and of the value's part apart."""
    if not apart:
        return clip_by_norm(gradient, limit)
    actor, actor_norm = clip_by_norm((gradient.policy, gradient.log_std), limit)
    critic, _ = clip_by_norm(gradient.value, limit)
    return ActorCritic(policy=actor[0], log_std=actor[1], value=critic), actor_norm


def _watch(rollout: Rollout, batch: Batch, params: ActorCritic) -> Metrics:
    """Scalars of the rollout, over all devices."""
    target_mean = mean_of_all(batch.target)
    target_variance = mean_of_all((batch.target - target_mean) ** 2)
    left = mean_of_all((batch.target - rollout.value) ** 2)
    return episode_metrics(rollout.reward, rollout.terminated, rollout.truncated) | {
        "explained_variance": 1.0 - left / jnp.maximum(target_variance, 1e-9),
        "std": jnp.mean(jnp.exp(params.log_std)),
    }
