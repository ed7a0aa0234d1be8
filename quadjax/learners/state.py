"""What a learner trains on, and the state of a training run."""

import dataclasses
from typing import Any

import jax
import optax
from flax import struct

from quadjax.core.environment import Environment, Vectorized
from quadjax.core.errors import InputError
from quadjax.core.mlp import Params
from quadjax.learners.networks import ActorCritic

Metrics = dict[str, jax.Array]


class Task(struct.PyTreeNode):
    """What a learner trains: a network on an environment, whose numbers are traced."""

    env_params: Any  # numbers of the environment
    # Of one environment, vectorized: states are batched along the last axis.
    environments: Vectorized = struct.field(pytree_node=False)
    network: ActorCritic = struct.field(pytree_node=False)

    @classmethod
    def of(cls, environment: Environment, network: ActorCritic, env_params: Any) -> "Task":
        """The task of an environment of one agent.

        Raises:
            InputError: an environment that is not hashable.
        """
        try:
            hash(environment)
        except TypeError:
            name = type(environment).__name__
            raise InputError(f"{name} is not hashable, allowed: a frozen dataclass") from None
        return cls(env_params, Vectorized(environment), network)


class TrainState(struct.PyTreeNode):
    """Everything that a run needs to resume; a checkpoint holds all of it."""

    params: Params  # of the ``ActorCritic``
    optimizer: optax.OptState
    target: Any  # parameters or None: slowly moving copy, whose value is the target critic
    env_states: Any  # of all environments, batched along the last axis
    key: jax.Array  # () PRNG key
    update: jax.Array  # () int32, number of updates done
    ema: Any = None  # parameters or None: exponential moving average of ``params``
    level: Any = None  # () in [0, 1]: position of the schedules by ``pass_rate``, if there are any

    @property
    def evaluated(self) -> Params:
        """The parameters to evaluate and to save: the moving average where there is one."""
        return self.params if self.ema is None else self.ema

    def next_state(self, env_states: Any, key: jax.Array, **changes: Any) -> "TrainState":
        """The state after an update, with what it changes; all else stays."""
        counters = {"env_states": env_states, "key": key, "update": self.update + 1}
        return dataclasses.replace(self, **counters, **changes)
