"""Layouts: the named fields of an observation, in order; their numbers and files.

The config section that selects the fields is in ``quadjax.race.observation_config``.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Self

import jax
import jax.numpy as jnp
from pydantic import ConfigDict

from quadjax.core.errors import InputError
from quadjax.core.imports import user_numbers
from quadjax.core.sections import LARGEST, Field, Section, model_validator, validate
from quadjax.race.types import RaceParams, Step
from quadjax.vehicle.protocol import VehicleModel

if TYPE_CHECKING:
    from quadjax.race.memory import Memory

Numbers = Sequence[jax.Array]  # each ()
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Bounds = tuple[Any, Any]  # pytrees of scalars: lowest (None: minus the highest) and highest
LAST_ACTION = "last_action"


@dataclasses.dataclass(frozen=True)
class ObservedField:
    """One named group of numbers of an observation.

    Attributes:
        name: unique in a layout.
        size: number of scalars.
        unit: unit of the numbers before they are scaled.
        frame: "gate" (x through the target gate, y to its right, z down), "body" or "".
        range: largest magnitude of a network input, after scaling, a power of two: the default of
            the export to fixed point.
        value: ``(step) -> numbers``, each (), pure; None in the layout of a file.
        scale: ``(model, params) -> (lowest, highest)`` that are scaled to -1 and 1; a lowest of
            None is minus the highest, and a range of zero width gives zero. None: not scaled.
        source: where the numbers of a disturbance come from: ground_truth, estimated or none.
        span: what ``scale`` gave in the race of the policy, one pair for each number, as a policy
            file stores it; None where unknown or not scaled.
        by_rotor: whether the numbers are one for each rotor: front-left, front-right, rear-right,
            rear-left. ``quadjax import --motors`` reorders them.
        memory: what ``value`` reads in ``step.memories``, if it needs a memory of the user's own.
    """

    name: str
    size: int
    unit: str
    frame: str
    range: float = 8.0
    value: Callable[[Step], Numbers] | None = dataclasses.field(default=None, repr=False)
    scale: Callable[[VehicleModel, RaceParams], Bounds] | None = dataclasses.field(
        default=None, repr=False
    )
    source: str = ""
    span: tuple[tuple[float, float], ...] | None = None
    by_rotor: bool = False
    memory: "Memory | None" = dataclasses.field(default=None, repr=False, compare=False)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each number: ``name[0]`` .., or ``name`` alone."""
        if self.size == 1:
            return (self.name,)
        return tuple(f"{self.name}[{i}]" for i in range(self.size))

    def numbers(self, step: Step, ends: Bounds | None = None) -> list[jax.Array]:
        """The field's network inputs, scaled by ``ends``, or by its own ``scale`` without these."""
        assert self.value is not None, self.name
        values = user_numbers(f"observation field {self.name!r}", self.value, step, self.size)
        if self.scale is None:
            return values
        low, high = map(jax.tree.leaves, self.scale(step.model, step.params))
        symmetric = not low
        if ends is not None:
            low, high = ([end[i] for i in range(self.size)] for end in ends)
        low = [None] * self.size if symmetric else low
        return [scale_to_unit(*x) for x in zip(values, low, high, strict=True)]


def scale_to_unit(value: jax.Array, low: jax.Array | None, high: jax.Array) -> jax.Array:
    """Map [low, high], or [-high, high], to [-1, 1]; zero if the range has no width."""
    if low is None:
        return jnp.where(high > 0, value / jnp.where(high > 0, high, 1.0), 0.0)
    width = high - low
    return (2.0 * value - low - high) / jnp.where(width == 0, jnp.inf, width)


class StoredField(Section):
    """The form of an ``ObservedField`` in a file, without its functions."""

    model_config = ConfigDict(extra="ignore")

    name: str
    size: int = Field(ge=1, le=4096)
    unit: str = ""
    frame: str = ""
    range: Number = 8.0
    source: str = ""
    span: tuple[tuple[Number, Number], ...] | None = Field(None, max_length=4096)

    @model_validator(mode="after")
    def _check(self) -> Self:
        span = self.span or ()
        if self.span is not None and len(span) != self.size or any(x > y for x, y in span):
            raise ValueError(f"span is {span}, allowed: [low, high] of {self.size} numbers")
        return self


@dataclasses.dataclass(frozen=True)
class Layout:
    """The fields of an observation, in order."""

    fields: tuple[ObservedField, ...]

    @property
    def size(self) -> int:
        """Total size of the fields."""
        return sum(field.size for field in self.fields)

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the fields, in order."""
        return tuple(field.name for field in self.fields)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each number."""
        return tuple(label for field in self.fields for label in field.labels)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def __getitem__(self, name: str) -> ObservedField:
        return self.fields[self.names.index(name)]

    def slice(self, name: str) -> slice:
        """Where a field's numbers are in the observation."""
        start = sum(field.size for field in self.fields[: self.names.index(name)])
        return slice(start, start + self[name].size)

    def numbers(self, step: Step) -> list[jax.Array]:
        """All numbers of one observation, each (), scaled by ``params.ranges`` if there are any."""
        numbers: list[jax.Array] = []
        for field in self.fields:
            ends, place = None, slice(len(numbers), len(numbers) + field.size)
            if (ranges := step.params.ranges) is not None:
                ends = ranges.observed[0][place], ranges.observed[1][place]
            numbers += field.numbers(step, ends)
        return numbers

    def with_spans(self, model: VehicleModel, params: RaceParams) -> "Layout":
        """The layout with the numbers of every scale."""

        def spans(field: ObservedField) -> ObservedField:
            if field.scale is None:
                return field
            low, high = (list(map(float, jax.tree.leaves(x))) for x in field.scale(model, params))
            low = low or [-x for x in high]
            return dataclasses.replace(field, span=tuple(zip(low, high, strict=True)))

        return Layout(tuple(map(spans, self.fields)))

    def to_meta(self) -> list[dict[str, object]]:
        """The layout as JSON takes it; ``from_meta`` reads it back."""
        return [{x: getattr(field, x) for x in StoredField.model_fields} for field in self.fields]

    @staticmethod
    def from_meta(value: object, where: str) -> "Layout":
        """A layout from a file's JSON, without functions.

        Raises:
            InputError: not a list of fields; ``where`` names it.
        """
        if not isinstance(value, list) or not value:
            raise InputError(f"{where} is {value!r:.80}, expected a list of fields")
        stored = (validate(StoredField, item, f"{where}[{i}]") for i, item in enumerate(value))
        layout = Layout(tuple(ObservedField(**dict(field)) for field in stored))
        if len(set(layout.names)) != len(layout.names):
            raise InputError(f"{where}: two fields have the same name")
        return layout
