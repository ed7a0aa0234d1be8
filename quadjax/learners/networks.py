"""Policy and value networks, separate perceptrons, and a state-independent standard deviation."""

import dataclasses
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import mlp
from quadjax.core.gradients import clip_inward
from quadjax.core.mlp import Layer

Tree = dict[str, dict[str, jax.Array]]  # Dense_0, Dense_1, ... -> kernel, bias


@struct.dataclass
class ActorCritic:
    """Parameters of a Gaussian policy and of a value function."""

    policy: Tree  # of the network that computes the mean action
    log_std: jax.Array  # (actions,), independent of the observation
    value: Tree  # of the network that computes the value


class _Initializer(nn.Module):
    """Initial parameters: orthogonal kernels, scaled by sqrt(2) but for the last, zero biases."""

    sizes: tuple[int, ...]
    last_scale: float

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        for width in self.sizes[:-1]:
            inputs = nn.Dense(width, kernel_init=nn.initializers.orthogonal(2.0**0.5))(inputs)
        last = nn.initializers.orthogonal(self.last_scale)
        return nn.Dense(self.sizes[-1], kernel_init=last)(inputs)


@dataclasses.dataclass(frozen=True)
class Networks:
    """Sizes and code of the two networks."""

    observation_size: int
    action_size: int
    hidden: tuple[int, ...]
    activation: str = "relu"
    clip_mean: bool = False  # clip the mean action to [-1, 1] before noise is added
    input_scale: tuple[float, ...] = ()  # factors on the observation; (): ones
    privileged_size: int = 0  # last numbers of the observation, which only the value takes

    def init(self, key: jax.Array) -> ActorCritic:
        """Initial parameters, with a ``log_std`` of zero."""
        policy_key, value_key = jax.random.split(key)
        return ActorCritic(
            policy=self._init(policy_key, self.policy_size, self.action_size, 0.01),
            log_std=jnp.zeros(self.action_size, jnp.float32),
            value=self._init(value_key, self.observation_size, 1, 1.0),
        )

    @property
    def policy_size(self) -> int:
        """Numbers of the observation that the policy takes."""
        return self.observation_size - self.privileged_size

    def _init(self, key: jax.Array, inputs: int, outputs: int, last_scale: float) -> Tree:
        blank = jnp.zeros((1, inputs))
        return _Initializer((*self.hidden, outputs), last_scale).init(key, blank)["params"]

    def mean(self, params: ActorCritic, observation: jax.Array) -> jax.Array:
        """Mean action (..., actions) of an observation (..., observation_size).

        Where ``clip_mean`` is set, gradients pass the clip if they point inwards; see
        ``quadjax.core.gradients.clip_inward``.
        """
        inputs = self._inputs(observation)[..., : self.policy_size]
        mean = mlp.apply(layers_of(params.policy), inputs, self.activation)
        return clip_inward(mean, -1.0, 1.0) if self.clip_mean else mean

    def _inputs(self, observation: jax.Array) -> jax.Array:
        return observation * jnp.array(self.input_scale) if self.input_scale else observation

    def value(self, params: ActorCritic, observation: jax.Array) -> jax.Array:
        """Value (...) of an observation (..., observation_size)."""
        return mlp.apply(layers_of(params.value), self._inputs(observation), self.activation)[
            ..., 0
        ]


def layers_of(tree: Tree) -> list[Layer]:
    """(kernel, bias) of each layer of a network's parameters, in order."""
    return [(tree[f"Dense_{i}"]["kernel"], tree[f"Dense_{i}"]["bias"]) for i in range(len(tree))]


def tree_of(layers: Sequence[Layer]) -> Tree:
    """A network's parameters from (kernel, bias) of each layer."""
    return {
        f"Dense_{i}": {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}
        for i, (kernel, bias) in enumerate(layers)
    }
