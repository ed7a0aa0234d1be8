"""Policy and value networks: separate, dense, and a state-independent standard deviation."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.gradients import clip_inward

ACTIVATIONS = {"relu": nn.relu, "tanh": nn.tanh}


class MLP(nn.Module):
    """Dense layers with an activation between them and none after the last."""

    hidden: tuple[int, ...]
    outputs: int
    activation: str
    last_scale: float  # of the last layer's orthogonal initialisation

    @nn.compact
    def __call__(self, inputs: jax.Array) -> jax.Array:
        """Map (.., inputs) to (.., outputs)."""
        value = inputs
        for width in self.hidden:
            init = nn.initializers.orthogonal(2.0**0.5)
            value = ACTIVATIONS[self.activation](nn.Dense(width, kernel_init=init)(value))
        last = nn.initializers.orthogonal(self.last_scale)
        return nn.Dense(self.outputs, kernel_init=last)(value)


@struct.dataclass
class ActorCritic:
    """Parameters of the policy, its noise and the value."""

    policy: dict  # of an MLP to the mean action
    log_std: jax.Array  # (actions,)
    value: dict  # of an MLP to one number


@dataclasses.dataclass(frozen=True)
class Networks:
    """The two networks; static."""

    observation_size: int
    action_size: int
    hidden: tuple[int, ...]
    activation: str = "relu"
    log_std: float = 0.0  # at the start
    bounded: bool = False  # clip the mean action to [-1, 1] before noise comes on top

    @property
    def policy(self) -> MLP:
        """The mean action's network."""
        return MLP(self.hidden, self.action_size, self.activation, 0.01)

    @property
    def value(self) -> MLP:
        """The value's network."""
        return MLP(self.hidden, 1, self.activation, 1.0)

    def init(self, key: jax.Array) -> ActorCritic:
        """Fresh parameters."""
        policy_key, value_key = jax.random.split(key)
        blank = jnp.zeros((1, self.observation_size))
        return ActorCritic(
            policy=self.policy.init(policy_key, blank)["params"],
            log_std=jnp.full((self.action_size,), self.log_std, jnp.float32),
            value=self.value.init(value_key, blank)["params"],
        )

    def mean(self, params: ActorCritic, observation: jax.Array) -> jax.Array:
        """Mean action (.., actions), to which noise is added.

        Where it is ``bounded``, the clip's gradient brings back what is beyond it; see
        ``quadjax.core.gradients.clip_inward``.
        """
        mean = self.policy.apply({"params": params.policy}, observation)
        return clip_inward(mean, -1.0, 1.0) if self.bounded else mean

    def evaluate(self, params: ActorCritic, observation: jax.Array) -> jax.Array:
        """Value (..) of an observation (.., observation_size)."""
        return self.value.apply({"params": params.value}, observation)[..., 0]


def layers_of(tree: dict) -> list[tuple[jax.Array, jax.Array]]:
    """(kernel, bias) of each dense layer of an MLP's parameters, in order."""
    return [(tree[f"Dense_{i}"]["kernel"], tree[f"Dense_{i}"]["bias"]) for i in range(len(tree))]


def tree_of(layers: list[tuple[jax.Array, jax.Array]]) -> dict:
    """An MLP's parameters from (kernel, bias) of each dense layer."""
    return {
        f"Dense_{i}": {"kernel": jnp.asarray(kernel), "bias": jnp.asarray(bias)}
        for i, (kernel, bias) in enumerate(layers)
    }
