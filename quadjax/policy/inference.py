"""Policies in flight: a policy file, or networks in training, as a function of what they see."""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import mlp
from quadjax.policy.file import Policy


@struct.dataclass
class Flying:
    """A policy's numbers on the device."""

    layers: tuple[tuple[jax.Array, jax.Array], ...]
    log_std: jax.Array  # (4,)
    activation: str = struct.field(pytree_node=False, default="relu")
    output: str = struct.field(pytree_node=False, default="clip")
    noise_on: str = struct.field(pytree_node=False, default="mean")


def flying(policy: Policy) -> Flying:
    """A policy file's numbers on the device."""
    layers = tuple(
        (jnp.asarray(kernel, jnp.float32), jnp.asarray(bias, jnp.float32))
        for kernel, bias in policy.layers
    )
    log_std = jnp.asarray(policy.log_std, jnp.float32)
    return Flying(layers, log_std, policy.activation, policy.output, policy.noise_on)


def mean_action(policy: Flying, observation: jax.Array) -> jax.Array:
    """Mean action (4,), squashed as the policy says; the last clip is left to the environment."""
    mean = mlp.apply(policy.layers, observation, policy.activation)
    if policy.output == "tanh":
        return jnp.tanh(mean)
    return jnp.clip(mean, -1.0, 1.0) if policy.noise_on == "clipped_mean" else mean


def act_deterministic(policy: Flying, observation: jax.Array, noise: jax.Array) -> jax.Array:
    """The mean action (4,)."""
    return mean_action(policy, observation)


def act_sampled(policy: Flying, observation: jax.Array, noise: jax.Array) -> jax.Array:
    """The mean action (4,) plus the policy's own noise, (4,) standard normal numbers.

    As in training, the noise comes on top of the mean or of the clipped mean; the environment clips
    the sum.
    """
    return mean_action(policy, observation) + jnp.exp(policy.log_std) * noise
