"""Inference: the actions of a policy, or of networks in training."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.learners import networks
from quadjax.learners.networks import ActorCritic


class PolicyParams(struct.PyTreeNode):
    """A policy's parameters on the device, and the module that applies them."""

    params: Mapping[str, Any]  # actor and log_std (actions,)
    network: ActorCritic = struct.field(pytree_node=False)


def mean_action(policy: PolicyParams, observation: jax.Array) -> jax.Array:
    """Mean action (.., actions); the last clip to [-1, 1] is left to the environment."""
    return networks.mean_action(policy.network, policy.params, observation)


def act_deterministic(policy: PolicyParams, observation: jax.Array, noise: jax.Array) -> jax.Array:
    """The mean action (.., actions)."""
    return mean_action(policy, observation)


def act_sampled(policy: PolicyParams, observation: jax.Array, noise: jax.Array) -> jax.Array:
    """The mean action (.., actions) plus the policy's noise, of standard normal numbers.

    As in training, the noise is added to the mean or to the clipped mean; the environment clips the
    sum.
    """
    return mean_action(policy, observation) + jnp.exp(policy.params["log_std"]) * noise
