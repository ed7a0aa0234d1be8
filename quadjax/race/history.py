"""History: fields of the observation as they were in earlier steps.

The state of the race keeps what the last observations were computed from: the vehicle's states and
the actions. A field of the history, ``velocity@5``, is the field ``velocity`` of the state of 5
steps before, seen from the present target gate: all fields of an observation have one frame, also
in the steps after a gate. At the start of an episode all earlier states are the first one.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.vehicle.protocol import State

if TYPE_CHECKING:
    from quadjax.race.environment import RaceState
    from quadjax.race.layout import Field, View

MARK = "@"  # between a field's name and the number of steps
LONGEST = 64  # steps
Action = tuple[jax.Array, ...] | None


@struct.dataclass
class Past:
    """Earlier states of one drone, the latest first."""

    drone: State  # of the vehicle model, each leaf (depth,)
    action: Action  # of the step before each, (depth,); None where no action is observed


def delayed(field: "Field", lag: int) -> "Field":
    """A field as it was ``lag`` steps before."""
    value = field.value
    assert value is not None, field.name

    def earlier(view: "View", value: Callable = value) -> Sequence[jax.Array]:
        return value(dataclasses.replace(view, state=_recalled(view.state, lag)))

    return dataclasses.replace(field, name=f"{field.name}{MARK}{lag}", value=earlier)


def split_name(name: str) -> tuple[str, int]:
    """The name of a field, and how many steps before it is meant: ``("velocity", 5)``; 0: now."""
    base, _, lag = name.rpartition(MARK)
    if not base or not lag.isdecimal() or not 1 <= int(lag[:6]) <= LONGEST:
        return name, 0
    return base, int(lag)


def depth(names: Sequence[str]) -> int:
    """The number of steps of which fields with these names need the states; 0: none."""
    return max((split_name(name)[1] for name in names), default=0)


def begin(names: Sequence[str], drone: State, action: Action) -> Past | None:
    """A history that is full of one state; None where no field needs one.

    Args:
        names: of the fields of the observation.
        drone: the vehicle's state.
        action: of the step before.
    """
    size = depth(names)
    if not size:
        return None
    return jax.tree.map(lambda x: jnp.full((size,), x), Past(drone, action))


def push(past: Past | None, drone: State, action: Action) -> Past | None:
    """The history one step later, with the state (and the action before it) of the step."""
    if past is None:
        return None
    return jax.tree.map(
        lambda old, new: jnp.concatenate([new[None], old[:-1]]), past, Past(drone, action)
    )


def _recalled(state: "RaceState", lag: int) -> "RaceState":
    """The race with the vehicle's state and the action of ``lag`` steps before."""
    past = state.past
    assert past is not None
    earlier = jax.tree.map(lambda x: x[lag - 1], past)
    return state.replace(drone=earlier.drone, action=earlier.action)
