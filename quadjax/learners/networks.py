"""The networks that a learner trains: a Gaussian policy and a value function, one Flax module."""

import jax
import jax.numpy as jnp
from flax import linen as nn

from quadjax.core.errors import InputError
from quadjax.core.gradients import clip_inward
from quadjax.core.mlp import MLP, Params, apply_module
from quadjax.core.shapes import check_traced

PARTS = ("actor", "critic")
NAMES = (*PARTS, "log_std")  # of the parameters


class ActorCritic(nn.Module):
    """Two separate networks, and a standard deviation that does not depend on the observation.

    Its parameters are ``{"actor": .., "critic": .., "log_std": (action_size,)}``. For other
    networks, override ``make_network`` in a subclass, or ``setup`` with these three names.

    Attributes:
        action_size: size of an action.
        hidden: units of each hidden layer.
        activation: of the hidden layers, "relu" or "tanh".
        clip_mean: clip the mean action to [-1, 1] before noise is added.
        privileged_size: number of last entries of the observation, which only the critic takes.
    """

    action_size: int
    hidden: tuple[int, ...] = (64, 64, 64)
    activation: str = "relu"
    clip_mean: bool = False
    privileged_size: int = 0

    def setup(self) -> None:
        """The two networks and ``log_std``, which is zero at first."""
        self.actor = self.make_network(self.action_size, 0.01)
        self.critic = self.make_network(1, 1.0)
        self.log_std = self.param("log_std", nn.initializers.zeros, (self.action_size,))

    def make_network(self, outputs: int, last_scale: float) -> nn.Module:
        """A module from inputs (..., n) to (..., outputs).

        Args:
            outputs: size of the output: ``action_size`` for the actor, 1 for the critic.
            last_scale: scale of the last layer's initial kernel; the actor's is small.
        """
        return MLP((*self.hidden, outputs), self.activation, last_scale)

    def __call__(self, observation: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean action and value of an observation, as ``mean`` and ``value``."""
        return self.mean(observation), self.value(observation)

    def mean(self, observation: jax.Array) -> jax.Array:
        """Mean action (..., action_size) of an observation (..., n).

        Where ``clip_mean`` is set, gradients pass the clip if they point inwards; see
        ``quadjax.core.gradients.clip_inward``.
        """
        mean = self.actor(observation[..., : observation.shape[-1] - self.privileged_size])
        what = f"the mean action of the network {type(self).__name__}"
        check_traced(what, mean, (*observation.shape[:-1], self.action_size))
        return clip_inward(mean, -1.0, 1.0) if self.clip_mean else mean

    def value(self, observation: jax.Array) -> jax.Array:
        """Value (...) of an observation (..., n)."""
        value = self.critic(observation)
        what = f"the value of the network {type(self).__name__}"
        check_traced(what, value, (*observation.shape[:-1], 1))
        return value[..., 0]


def initial_params(network: ActorCritic, key: jax.Array, observation_size: int) -> Params:
    """Initial parameters of a network.

    Raises:
        InputError: the parameters of a user's network do not have these three names.
    """
    variables = network.init(key, jnp.zeros(observation_size))
    found = set(variables) - {"params"} | set(variables.get("params", ()))
    if found != set(NAMES):
        raise InputError(
            f"{type(network).__name__} has variables {', '.join(sorted(found))}, expected the "
            f"parameters {', '.join(NAMES)}; policy and value share none"
        )
    return variables["params"]


def mean_action(network: ActorCritic, params: Params, observation: jax.Array) -> jax.Array:
    """Mean action (..., action_size) of a network with given parameters."""
    return apply_module(network, params, observation, "mean")


def predict_value(network: ActorCritic, params: Params, observation: jax.Array) -> jax.Array:
    """Value (...) of a network with given parameters."""
    return apply_module(network, params, observation, "value")
