"""Policy and value networks, separate perceptrons, and a state-independent standard deviation."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import mlp
from quadjax.core.gradients import clip_inward
from quadjax.core.mlp import Layer


@struct.dataclass
class ActorCritic:
    """Parameters of a Gaussian policy and of a value function.

    Those of a perceptron are (kernel, bias) of each layer, in order, as in ``quadjax.core.mlp``.
    """

    policy: Any  # of the network that computes the mean action
    log_std: jax.Array  # (actions,), independent of the observation
    value: Any  # of the network that computes the value


@dataclasses.dataclass(frozen=True)
class Networks:
    """Sizes and code of the two networks.

    Learners use ``init``, ``mean``, ``value`` and ``action_size``; an object of another class with
    these serves as well.
    """

    observation_size: int
    action_size: int
    hidden: tuple[int, ...]
    activation: str = "relu"
    clip_mean: bool = False  # clip the mean action to [-1, 1] before noise is added
    privileged_size: int = 0  # last numbers of the observation, which only the value takes

    def init(self, key: jax.Array) -> ActorCritic:
        """Initial parameters, with a ``log_std`` of zero."""
        policy_key, value_key = jax.random.split(key)
        return ActorCritic(
            policy=_layers(policy_key, (self.policy_size, *self.hidden, self.action_size), 0.01),
            log_std=jnp.zeros(self.action_size, jnp.float32),
            value=_layers(value_key, (self.observation_size, *self.hidden, 1), 1.0),
        )

    @property
    def policy_size(self) -> int:
        """Numbers of the observation that the policy takes."""
        return self.observation_size - self.privileged_size

    def mean(self, params: ActorCritic, observation: jax.Array) -> jax.Array:
        """Mean action (..., actions) of an observation (..., observation_size).

        Where ``clip_mean`` is set, gradients pass the clip if they point inwards; see
        ``quadjax.core.gradients.clip_inward``.
        """
        inputs = observation[..., : self.policy_size]
        mean = mlp.apply(params.policy, inputs, self.activation)
        return clip_inward(mean, -1.0, 1.0) if self.clip_mean else mean

    def value(self, params: ActorCritic, observation: jax.Array) -> jax.Array:
        """Value (...) of an observation (..., observation_size)."""
        return mlp.apply(params.value, observation, self.activation)[..., 0]


def _layers(key: jax.Array, sizes: tuple[int, ...], last_scale: float) -> tuple[Layer, ...]:
    """Initial layers: orthogonal kernels, scaled by sqrt(2) but for the last, and zero biases."""
    layers = []
    for i, (rows, columns) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        scale = last_scale if i == len(sizes) - 2 else 2.0**0.5
        kernel = jax.nn.initializers.orthogonal(scale)(jax.random.fold_in(key, i), (rows, columns))
        layers.append((kernel, jnp.zeros(columns)))
    return tuple(layers)
