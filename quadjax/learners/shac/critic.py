"""The critic's steps: regression to TD(lambda) targets."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import optax

from quadjax.learners.metrics import explained_variance
from quadjax.learners.minibatches import shuffled, take_rows, to_blocks
from quadjax.learners.networks import ActorCritic, Networks, Tree
from quadjax.learners.optimization import clip_by_norm, select
from quadjax.learners.shac.actor import adam_step
from quadjax.learners.shac.hyperparameters import SHAC
from quadjax.learners.shards import split_keys
from quadjax.learners.state import AXIS, Metrics, TrainState

Carry = tuple[Tree, optax.OptState]


def fit_critic(
    networks: Networks,
    hyper: SHAC,
    state: TrainState,
    observation: jax.Array,
    targets: jax.Array,
    keys: jax.Array,
) -> tuple[Tree, optax.OptState, Metrics]:
    """Several epochs of minibatches of whole trajectories.

    Args:
        networks: the policy and the value.
        hyper: hyperparameters.
        state: its critic is fitted further.
        observation: (time, n, observation_size).
        targets: (time, n).
        keys: (shards,) PRNG keys.

    Returns:
        The critic's parameters, Adam's state, and metrics.
    """
    blocks = to_blocks((observation, targets), keys.shape[0], targets.shape[0])
    count = blocks[1].shape[1]

    def minibatch(carry: Carry, chosen: jax.Array) -> tuple[Carry, jax.Array]:
        return _critic_step(networks, hyper, state.params, carry, *take_rows(blocks, chosen))

    def epoch(carry: Carry, keys: jax.Array) -> tuple[Carry, jax.Array]:
        return jax.lax.scan(minibatch, carry, shuffled(keys, count, hyper.critic_minibatches))

    epoch_keys = jnp.stack(split_keys(keys, hyper.critic_epochs))
    carry = (state.params.value, state.optimizer[1])
    (value, optimizer), errors = jax.lax.scan(epoch, carry, epoch_keys)
    metrics = {
        "value_loss": errors.mean(),
        "explained_variance": explained_variance(errors[-1].mean(), targets),
    }
    return value, optimizer, metrics


def _critic_step(
    networks: Networks,
    hyper: SHAC,
    params: ActorCritic,
    carry: Carry,
    observation: jax.Array,
    target: jax.Array,
) -> tuple[Carry, jax.Array]:
    """One step of Adam on a minibatch of rows; a gradient that is not finite changes nothing."""
    value, optimizer = carry
    chex.assert_equal_shape_prefix((observation, target), 1)

    def loss(value: Tree) -> jax.Array:
        predicted = networks.value(dataclasses.replace(params, value=value), observation)
        return jnp.mean((predicted - target) ** 2)

    error, gradient = jax.lax.pmean(jax.value_and_grad(loss)(value), AXIS)
    gradient, norm = clip_by_norm(gradient, hyper.critic_max_grad_norm)
    new = adam_step(hyper, hyper.critic_learning_rate, gradient, value, optimizer)
    return select(jnp.isfinite(norm), new, carry), error
