"""The clipped objective, the value loss and what to watch of them."""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.ppo.rollout import log_probability
from quadjax.learners.state import AXIS, Metrics


@struct.dataclass
class Batch:
    """Steps of one gradient; the leading axes are all batch."""

    observation: jax.Array  # (.., observation_size)
    action: jax.Array  # (.., actions)
    log_prob: jax.Array  # (..) under the policy that flew
    advantage: jax.Array  # (..)
    target: jax.Array  # (..) value target


def normalise(advantage: jax.Array) -> jax.Array:
    """Zero mean and unit deviation over the batch, on all devices together."""
    mean = jax.lax.pmean(jnp.mean(advantage), AXIS)
    variance = jax.lax.pmean(jnp.mean((advantage - mean) ** 2), AXIS)
    return (advantage - mean) / (jnp.sqrt(variance) + 1e-8)


def loss(
    params: ActorCritic,
    networks: Networks,
    batch: Batch,
    clip: jax.Array,
    value_coefficient: jax.Array,
    entropy_coefficient: jax.Array,
) -> tuple[jax.Array, Metrics]:
    """PPO's loss () of one batch, and its parts.

    ``approx_kl`` is the estimator ``mean((r - 1) - log r)`` of KL(old, new) with ``r`` the ratio
    of the densities (Schulman, 2020).
    """
    mean = networks.mean(params, batch.observation)
    log_ratio = log_probability(batch.action, mean, params.log_std) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    advantage = normalise(batch.advantage)
    clipped = jnp.clip(ratio, 1.0 - clip, 1.0 + clip)
    policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    value = networks.evaluate(params, batch.observation)
    value_loss = jnp.mean((value - batch.target) ** 2)
    entropy = jnp.sum(params.log_std + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e))
    total = policy_loss + value_coefficient * value_loss - entropy_coefficient * entropy
    return total, {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "approx_kl": jnp.mean((ratio - 1.0) - log_ratio),
        "clip_fraction": jnp.mean((jnp.abs(ratio - 1.0) > clip).astype(ratio.dtype)),
    }
