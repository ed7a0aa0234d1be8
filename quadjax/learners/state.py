"""Networks, the state of a training run, and the interface of a learner."""

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import jax
import jax.numpy as jnp
import optax
from flax import struct

from quadjax.core import mlp
from quadjax.core.gradients import clip_inward
from quadjax.core.mlp import Layer

Params = TypeVar("Params")
Metrics = dict[str, jax.Array]


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


@struct.dataclass
class TrainState:
    """Everything that a run needs to resume; a checkpoint holds all of it."""

    params: ActorCritic
    optimizer: optax.OptState
    target: Any  # ActorCritic or None: slowly moving copy, whose value is the target critic
    environment: Any  # states of all environments, batched along the last axis
    key: jax.Array  # () PRNG key
    update: jax.Array  # () int32, number of updates done
    ema: Any = None  # ActorCritic or None: exponential moving average of ``params``
    level: Any = None  # () in [0, 1]: position of the schedules by ``pass_rate``, if there are any

    @property
    def evaluated(self) -> ActorCritic:
        """The parameters to evaluate and to save: the moving average where there is one."""
        return self.params if self.ema is None else self.ema

    def following(self, environment: Any, key: jax.Array, **changes: Any) -> "TrainState":
        """The state after an update, with what it changes; all else stays."""
        counters = {"environment": environment, "key": key, "update": self.update + 1}
        return dataclasses.replace(self, **counters, **changes)


Update = Callable[[Any, Any, TrainState], tuple[TrainState, Metrics]]


@dataclasses.dataclass(frozen=True)
class Learner(Generic[Params]):
    """An algorithm bound to an environment: what the training loop runs.

    ``init(hyper, environment_params, key)`` returns the first state of a run.
    ``update(hyper, environment_params, state)`` does one update of all environments and returns the
    next state and scalar metrics. Both are pure functions of whole arrays; ``hyper`` and
    ``environment_params`` are traced. On several devices, ``TrainState.environment`` is split along
    its last axis, and the compiler divides the work that depends on it.
    """

    init: Callable[[Any, Params, jax.Array], TrainState]
    update: Update
    hyper: Any  # pytree of hyperparameters
    steps_per_update: int  # environment steps of one update, all environments together
