"""The base class of learners, which trains on any environment; the section of the networks."""

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import jax
import numpy as np

from quadjax.core.environment import Environment
from quadjax.core.errors import InputError
from quadjax.core.imports import load_object
from quadjax.core.mlp import Params
from quadjax.core.precision import single_precision
from quadjax.core.sections import (
    LARGEST,
    MAX_SEED,
    Code,
    Field,
    Section,
    Unit,
    check_integer,
    validate,
)
from quadjax.core.traced import as_leaves, register
from quadjax.learners.loop import Plan, Row, plan_chunks, train_chunks
from quadjax.learners.networks import ActorCritic, mean_action
from quadjax.learners.parallel import choose_mesh, compile_chunk, place
from quadjax.learners.schedules import Schedule, Training
from quadjax.learners.state import Metrics, Task, TrainState

CHUNKS = 20  # of a run, about: how often progress is reported
MAX_ENVS = 1_000_000
Width = Annotated[int, Field(ge=1, le=8192)]
Count = Annotated[int, Field(ge=1, le=100_000)]
NumEnvs = Annotated[
    int,
    Unit("environments"),
    Field(ge=1, le=MAX_ENVS, description="number of environments simulated in parallel"),
]
Discount = Annotated[
    float, Unit("decay"), Field(ge=0, lt=1, description="discount factor per step")
]
RewardScale = Annotated[
    float, Field(gt=0, le=LARGEST, description="factor on the reward in training")
]


class Network(Section):
    """Policy and value networks: two separate multilayer perceptrons of the same widths."""

    module: Annotated[str | None, Code()] = Field(
        None,
        description="module:Class of your own subclass of quadjax.ActorCritic, constructed with "
        "hidden and activation; null: multilayer perceptrons",
    )
    hidden: tuple[Width, ...] = Field(
        (64, 64, 64), min_length=1, max_length=16, description="units of each hidden layer"
    )
    activation: Literal["relu", "tanh"] = Field(
        "relu", description="activation of the hidden layers"
    )
    normalize: bool = Field(
        False,
        description="train on lengths in legs and on times in leg times of the race; the policy "
        "file has plain units in any case",
    )

    def make(self, action_size: int, **fields: Any) -> ActorCritic:
        """The Flax module of both networks.

        Args:
            action_size: size of an action.
            fields: further fields of ``ActorCritic``.

        Raises:
            InputError: ``module`` names no ``ActorCritic``.
        """
        kind = ActorCritic if self.module is None else load_object(self.module, "network.module")
        if not (isinstance(kind, type) and issubclass(kind, ActorCritic)):
            raise InputError(
                f"network.module is {self.module}, expected a subclass of quadjax.ActorCritic"
            )
        return kind(action_size, self.hidden, self.activation, **fields)


Schedules = Mapping[str, Schedule | Sequence[float | Literal["value"]]]


@dataclasses.dataclass(frozen=True)
class TrainResult:
    """The result of a training run."""

    policy: Callable[[jax.Array], jax.Array]  # observation (..., n) -> mean action (..., k)
    # of the ``ActorCritic``; averaged, where the learner averages
    parameters: Params = dataclasses.field(repr=False)
    metrics: dict[str, np.ndarray] = dataclasses.field(repr=False)  # (updates,) each
    steps: int  # environment steps done


class Learner(Section):
    """The base class of learning algorithms: fields are hyperparameters, methods the algorithm.

    A learner is a pytree. In ``init`` and ``update``, its fields of ``float``, and of tuples and
    mappings of it, are arrays: other numbers do not trigger recompilation, and schedules can change
    them. All others fix shapes or code, and so does None. There ``replace`` takes arrays, and
    does not validate.

    Both methods are pure functions of whole arrays. On several devices, ``TrainState.env_states``
    is split along its last axis, and the compiler divides the work that depends on it.
    """

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """A hyperparameter of the learner's own class."""

    # What action noise is added to. PPO's is learned and added to the network's output; far beyond
    # the limits it has no effect, so a policy can become deterministic. SHAC's is not learned and
    # added to the clipped mean, so that exploration continues at a limit. Both learners are much
    # worse with the other choice.
    noise_on: ClassVar[Literal["mean", "clipped_mean"]] = "mean"

    algorithm: Annotated[str, Code()] = Field(
        "", description="ppo, shac, or module:Class of a learner of your own"
    )

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Every learner is a pytree."""
        register(cls)

    @property
    def steps_per_update(self) -> int:
        """Environment steps of one update, of all environments together."""
        raise InputError(f"{type(self).__name__} has no steps_per_update, allowed: a property")

    def init(self, task: Task, key: jax.Array) -> TrainState:
        """The first state of a run."""
        raise InputError(f"{type(self).__name__} has no init(task, key), allowed: a method")

    def update(self, task: Task, state: TrainState) -> tuple[TrainState, Metrics]:
        """The state after one update of all environments, and scalar metrics."""
        raise InputError(f"{type(self).__name__} has no update(task, state), allowed: a method")

    def plan(self, steps: int, steps_per_chunk: int) -> Plan:
        """How a run of a number of environment steps is divided.

        Raises:
            InputError: ``steps_per_update`` is no positive integer.
        """
        size = self.steps_per_update
        check_integer(f"steps_per_update of {type(self).__name__}", size, 1, 10**12)
        return plan_chunks(steps, steps_per_chunk, size)

    @single_precision
    def train(
        self,
        environment: Environment,
        params: Any,
        steps: int,
        seed: int = 0,
        network: Network | ActorCritic | None = None,
        schedules: Schedules | None = None,
        progress: Callable[[Row], None] | None = None,
    ) -> TrainResult:
        """Train a policy on an environment, in memory: without a folder or checkpoints.

        On a CPU, call ``quadjax.learners.parallel.prepare_devices("auto")`` before JAX computes
        anything, so that a run uses all cores.

        Args:
            environment: three pure functions of one agent.
            params: traced parameters of the environment.
            steps: environment steps of the run, at least; a whole number of updates.
            seed: seed of all random numbers.
            network: hidden layers of policy and value, or a module of the user's own, whose
                ``clip_mean`` is the learner's; ``normalize``, in units of a race, has no effect.
            schedules: numbers that change during training: a ``Schedule``, or only its values, by
                the name of a hyperparameter or the dotted path of a leaf of ``params``, such as
                ``{"learning_rate": [3e-3, 0.0], "reward.gate": Schedule(linear=(0, 10))}``.
            progress: called with a row of metrics after every chunk of updates.

        Returns:
            The policy, its parameters, and the metrics of every update.

        Raises:
            InputError: a schedule without effect, or a number out of range.
            NonFiniteError: a metric is not finite.
        """
        check_integer("steps", steps, 1, 10**12)
        check_integer("seed", seed, 0, MAX_SEED)
        network = self._network(environment, network)
        plan = self.plan(steps, max(1, steps // CHUNKS))
        training = Training(as_leaves(self), Task.of(environment, network, params))
        chosen = self._checked(schedules or {})
        training = training.with_schedules(chosen, self._paths, plan, steps)
        state = jax.jit(Training.init)(training, jax.random.key(seed))
        mesh = choose_mesh("auto", state)
        state = place(state, mesh)
        chunk = compile_chunk(training, mesh, plan.updates_per_chunk, state)
        history: list[dict[str, np.ndarray]] = []
        started = time.monotonic()
        for latest in train_chunks(chunk, state, plan):
            state = latest.state
            history.append(latest.metrics)
            if progress is not None:
                progress({"seconds": time.monotonic() - started} | latest.row)
        parameters = jax.device_get(state.evaluated)
        return TrainResult(
            policy=single_precision(
                jax.jit(lambda observation: mean_action(network, parameters, observation))
            ),
            parameters=parameters,
            metrics={name: np.concatenate([h[name] for h in history]) for name in history[0]},
            steps=plan.steps,
        )

    def _checked(self, schedules: Schedules) -> dict[str, Schedule]:
        """Schedules by key, whose values of hyperparameters are allowed."""
        made: dict[str, Schedule] = {}
        for key, values in schedules.items():
            if isinstance(values, Schedule):
                made[key] = values
            elif isinstance(values, list | tuple):
                made[key] = validate(Schedule, {"linear": values}, key)
            else:
                allowed = "a list of values or a quadjax.Schedule"
                raise InputError(f"schedules: {key} is {values!r:.60}, allowed: {allowed}")
        for key, schedule in made.items():
            name = key.removeprefix("learner.")
            if name in type(self).model_fields:
                for value in schedule.linear:
                    self.replace(**({} if value == "value" else {name: value}))
        return made

    def _paths(self, key: str) -> tuple[str, ...]:
        """The path of the number of a key: a hyperparameter, or one of the environment."""
        name = key.removeprefix("learner.")
        return (f"learner.{name}" if name in type(self).model_fields else f"params.{key}",)

    def _network(
        self, environment: Environment, network: Network | ActorCritic | None
    ) -> ActorCritic:
        """The module for an environment; the mean action is clipped where the learner needs it."""
        if network is None or isinstance(network, Network):
            network = (network or Network()).make(environment.action_size)
        if not isinstance(network, ActorCritic):
            raise InputError(f"network is {network!r:.60}, expected a Network or an ActorCritic")
        if network.action_size != environment.action_size:
            raise InputError(
                f"network.action_size is {network.action_size}, the environment takes "
                f"{environment.action_size}"
            )
        return network.clone(clip_mean=self.noise_on == "clipped_mean")


def check_divisor(name: str, value: int, total: int, of: str) -> None:
    """Raise a ``ValueError`` if a hyperparameter does not divide ``total``, the number ``of``."""
    if total % value:
        raise ValueError(f"{name} is {value}, allowed: a divisor of {total} ({of})")
