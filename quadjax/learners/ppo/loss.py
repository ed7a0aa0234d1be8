"""The clipped surrogate objective, the value loss and their metrics."""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.learners.networks import ActorCritic, Networks
from quadjax.learners.ppo.hyperparameters import PPO
from quadjax.learners.ppo.rollout import log_probability
from quadjax.learners.state import AXIS, Metrics


@struct.dataclass
class Batch:
    """Steps to learn from; the leading axes are all batch."""

    observation: jax.Array  # (..., observation_size)
    action: jax.Array  # (..., actions)
    log_prob: jax.Array  # (...) under the policy that sampled the action
    advantage: jax.Array  # (...)
    target: jax.Array  # (...) value target


def normalize(advantage: jax.Array) -> jax.Array:
    """Advantages with zero mean and unit variance over the batch on all devices."""
    mean = jax.lax.pmean(jnp.mean(advantage), AXIS)
    variance = jax.lax.pmean(jnp.mean((advantage - mean) ** 2), AXIS)
    return (advantage - mean) / (jnp.sqrt(variance) + 1e-8)


def loss(
    params: ActorCritic, networks: Networks, hyper: PPO, batch: Batch
) -> tuple[jax.Array, Metrics]:
    """PPO's loss () of one minibatch, and its parts (Schulman et al., 2017, eq. 7 and 9).

    ``-mean(min(r A, clip(r, 1 - c, 1 + c) A)) + c_v mean((V - G)^2) - c_e H``, with ``r`` the
    ratio of the new to the old probability density, ``A`` the normalized advantage and ``G`` the
    value target. ``approx_kl`` is the estimator ``mean((r - 1) - log r)`` of KL(old, new)
    (Schulman, "Approximating KL divergence", 2020).
    """
    mean = networks.mean(params, batch.observation)
    log_ratio = log_probability(batch.action, mean, params.log_std) - batch.log_prob
    ratio = jnp.exp(log_ratio)
    advantage = normalize(batch.advantage)
    clipped = jnp.clip(ratio, 1.0 - hyper.clip_range, 1.0 + hyper.clip_range)
    policy_loss = -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    value = networks.value(params, batch.observation)
    value_loss = jnp.mean((value - batch.target) ** 2)
    entropy = jnp.sum(params.log_std + 0.5 * jnp.log(2.0 * jnp.pi * jnp.e))
    total = policy_loss + hyper.value_coefficient * value_loss - hyper.entropy_coefficient * entropy
    return total, {
        "policy_loss": policy_loss,
        "value_loss": value_loss,
        "entropy": entropy,
        "approx_kl": jnp.mean((ratio - 1.0) - log_ratio),
        "clip_fraction": jnp.mean((jnp.abs(ratio - 1.0) > hyper.clip_range).astype(ratio.dtype)),
    }
