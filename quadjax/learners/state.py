"""The state of a training run, and the interface of a learner."""

import dataclasses
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import jax
import optax
from flax import struct

from quadjax.core.mlp import Params as NetworkParams

Params = TypeVar("Params")
Metrics = dict[str, jax.Array]


class TrainState(struct.PyTreeNode):
    """Everything that a run needs to resume; a checkpoint holds all of it."""

    params: NetworkParams  # of the ``ActorCritic``
    optimizer: optax.OptState
    target: Any  # parameters or None: slowly moving copy, whose value is the target critic
    environment: Any  # states of all environments, batched along the last axis
    key: jax.Array  # () PRNG key
    update: jax.Array  # () int32, number of updates done
    ema: Any = None  # parameters or None: exponential moving average of ``params``
    level: Any = None  # () in [0, 1]: position of the schedules by ``pass_rate``, if there are any

    @property
    def evaluated(self) -> NetworkParams:
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
