"""What a race remembers from one control step to the next: the last action, an estimate, your own.

A ``Memory`` begins with an episode and advances after every step. ``RaceState.memories`` holds the
values by name: those after the last step where they are observed, and those before the step where a
reward term or a rule reads them. In flights on a plant a memory advances with the estimated state.
"""

import contextlib
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.errors import USER_ERRORS, InputError, user_error
from quadjax.core.vectors import Vec3
from quadjax.race.layout import LAST_ACTION
from quadjax.race.types import RaceParams, RaceState, Step
from quadjax.vehicle import estimator
from quadjax.vehicle.estimator import EstimatorState
from quadjax.vehicle.protocol import VehicleModel

if TYPE_CHECKING:
    from quadjax.race.environment import Race

DISTURBANCE = "disturbance"


class Memory:
    """The base class of memories.

    An ``ObservedField`` names one of your own as its ``memory``, and so does a reward term or a
    rule: a function with an attribute ``memory``. Both methods are pure and written with
    ``jax.numpy``.

    Attributes:
        name: of the value in ``step.memories``; unique in a race.
    """

    name: str

    def is_used(self, race: "Race", params: RaceParams) -> bool:
        """Whether a race remembers it."""
        return True

    def begin(self, model: VehicleModel, params: RaceParams, state: RaceState) -> Any:
        """The value at the start of an episode: a pytree of arrays."""
        raise NotImplementedError

    def advance(self, value: Any, step: Step) -> Any:
        """The value after a step, of the same shapes; ``step.outcome`` is None on a plant."""
        raise NotImplementedError


class LastAction(Memory):
    """The action of the step before, each number () within [-1, 1]; zeros before the first."""

    name = LAST_ACTION

    def is_used(self, race: "Race", params: RaceParams) -> bool:
        """Where it is observed, rewarded, or acts late."""
        needed = params.reward.action_change is not None or params.delay is not None
        return needed or LAST_ACTION in race.layout

    def begin(self, model: VehicleModel, params: RaceParams, state: RaceState) -> Any:
        """Zeros."""
        return tuple(jnp.zeros(()) for _ in range(model.action_size))

    def advance(self, value: Any, step: Step) -> Any:
        """The action of the step."""
        assert step.action is not None
        return clipped_action(step.action)


class Estimate(struct.PyTreeNode):
    """The onboard estimate of the external disturbance."""

    filter: EstimatorState | None  # None: an estimate without its filter
    moment: Vec3  # N m, body
    force: Vec3  # m/s^2, body


class EstimatedDisturbance(Memory):
    """The ``Estimate`` by the onboard filters; no gradient flows through them."""

    name = DISTURBANCE

    def is_used(self, race: "Race", params: RaceParams) -> bool:
        """Where the race has an estimator."""
        return params.estimator is not None

    def begin(self, model: VehicleModel, params: RaceParams, state: RaceState) -> Estimate:
        """Zero, with the filters at rest."""
        assert params.estimator is not None
        measured = model.measure(params.vehicle_of(state), state.drone)
        return Estimate(estimator.init(params.estimator, measured), Vec3.zero(), Vec3.zero())

    def advance(self, value: Estimate, step: Step) -> Estimate:
        """The estimate after the measurement of the step."""
        params = step.params
        assert params.estimator is not None and value.filter is not None
        vehicle = params.vehicle_of(step.state)
        measured = jax.lax.stop_gradient(step.model.measure(vehicle, step.drone))
        return Estimate(*estimator.update(params.estimator, value.filter, measured))


METHODS = {"begin": "model, params, state", "advance": "value, step"}  # that a memory has to have
MEMORIES: tuple[Memory, ...] = (EstimatedDisturbance(), LastAction())


def clipped_action(action: jax.Array) -> tuple[jax.Array, ...]:
    """The numbers of an action (n,), clipped to [-1, 1], without a gradient beyond the limits.

    The command of an action is clipped too, with another gradient (``environment.command``).
    """
    return tuple(jnp.clip(action[i], -1.0, 1.0) for i in range(action.shape[0]))


def memories_of(race: "Race", params: RaceParams) -> list[Memory]:
    """The memories that a race uses; those of the user's fields, terms and rules come last.

    Raises:
        InputError: two memories with the same name, an object that is no ``Memory``, or one
            without its methods.
    """
    owners: list[tuple[str, Any]] = [(field.name, field) for field in race.layout.fields]
    found: dict[str, Memory] = {memory.name: memory for memory in MEMORIES}
    for of, owner in (*owners, *race.user_terms, *race.user_rules):
        memory = getattr(owner, "memory", None)
        if memory is None:
            continue
        if not (isinstance(memory, Memory) and isinstance(getattr(memory, "name", None), str)):
            allowed = "a quadjax.Memory with a name"
            raise InputError(f"{of}: memory is {memory!r:.60}, allowed: {allowed}")
        for name, arguments in METHODS.items():
            if getattr(type(memory), name) is getattr(Memory, name):
                raise InputError(f"{of}: {type(memory).__name__} has no {name}({arguments})")
        if found.setdefault(memory.name, memory) is not memory:
            allowed = "one object for all that share it"
            raise InputError(f"{of}: another memory is named {memory.name!r}, allowed: {allowed}")
    return [memory for memory in found.values() if memory.is_used(race, params)]


def begin_memories(race: "Race", params: RaceParams, state: RaceState) -> RaceState:
    """The state at the start of an episode, with new memories."""
    values = {}
    for memory in memories_of(race, params):
        with _one_line(memory):
            values[memory.name] = memory.begin(race.model, params, state)
            if values[memory.name] is None:
                raise InputError(f"memory {memory.name!r}: begin gives None, allowed: arrays")
    return state.replace(memories=values)


def advance_memories(race: "Race", step: Step) -> dict[str, Any]:
    """The memories after a step, those that the state has."""
    values = dict(step.memories)
    for memory in memories_of(race, step.params):
        if memory.name in values:
            before = values[memory.name]
            with _one_line(memory):
                values[memory.name] = memory.advance(before, step)
                _check_same(memory, before, values[memory.name])
    return values


@contextlib.contextmanager
def _one_line(memory: Memory) -> Iterator[None]:
    """An error of a user's own memory as an ``InputError``."""
    try:
        yield
    except InputError:
        raise
    except USER_ERRORS as error:
        if memory in MEMORIES:
            raise
        raise InputError(f"memory {memory.name!r}: {user_error(error)}") from error


def _check_same(memory: Memory, before: Any, after: Any) -> None:
    """Check that a value keeps its structure, its shapes and its types."""
    kinds = [
        jax.tree.map(lambda x: f"{jnp.result_type(x)} {jnp.shape(x)}", value)
        for value in (after, before)
    ]
    if kinds[0] != kinds[1]:
        found, expected = (str(kind).replace("'", "") for kind in kinds)
        raise InputError(
            f"memory {memory.name!r}: advance gives {found}, expected {expected}, as begin"
        )
