"""Inference: the actions of a policy, or of networks in training."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import mlp

if TYPE_CHECKING:
    from quadjax.policy.file import Policy


@struct.dataclass
class PolicyParams:
    """A policy's numbers on the device."""

    layers: tuple[tuple[jax.Array, jax.Array], ...]
    log_std: jax.Array  # (actions,)
    activation: str = struct.field(pytree_node=False, default="relu")
    noise_on: str = struct.field(pytree_node=False, default="mean")


def policy_params(policy: "Policy") -> PolicyParams:
    """A policy's numbers on the device."""
    layers = tuple(
        (jnp.asarray(kernel, jnp.float32), jnp.asarray(bias, jnp.float32))
        for kernel, bias in policy.layers
    )
    log_std = jnp.asarray(policy.log_std, jnp.float32)
    return PolicyParams(layers, log_std, policy.activation, policy.noise_on)


def mean_action(policy: PolicyParams, observation: jax.Array) -> jax.Array:
    """Mean action (.., actions); the last clip to [-1, 1] is left to the environment."""
    mean = mlp.apply(policy.layers, observation, policy.activation)
    return jnp.clip(mean, -1.0, 1.0) if policy.noise_on == "clipped_mean" else mean


def act_deterministic(policy: PolicyParams, observation: jax.Array, noise: jax.Array) -> jax.Array:
    """The mean action (.., actions)."""
    return mean_action(policy, observation)


def act_sampled(policy: PolicyParams, observation: jax.Array, noise: jax.Array) -> jax.Array:
    """The mean action (.., actions) plus the policy's noise, of standard normal numbers.

    As in training, the noise is added to the mean or to the clipped mean; the environment clips the
    sum.
    """
    return mean_action(policy, observation) + jnp.exp(policy.log_std) * noise
