"""The box of inputs that a fixed-point policy is declared for: one power of two per field."""

import dataclasses
import math

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.names import POWER_OF_TWO, is_range
from quadjax.policy.file import Policy
from quadjax.race.layout import LAST_ACTION, Layout
from quadjax.race.observations import DISTURBANCES, GATES_AHEAD, HIGHEST_RPM, fields_of
from quadjax.race.track import Track, gates_ahead, unwrapped_turns
from quadjax.vehicle.registry import MODELS

ROUNDING = 1.0 + 2.0**-20  # of a scaled input, in single precision; the C clips it to its range


@dataclasses.dataclass(frozen=True)
class InputBox:
    """Symmetric ranges ``+-2**exponent`` of every input."""

    layout: Layout  # of the inputs
    exponent: dict[str, int]  # by field, also of fields that the policy does not observe
    scaled_fields: tuple[str, ...]  # fields that are scaled to [-1, 1] over their spans

    @property
    def exponents(self) -> tuple[int, ...]:
        """The exponent of every input."""
        return tuple(self.exponent[f.name] for f in self.layout.fields for _ in range(f.size))

    @property
    def ranges(self) -> np.ndarray:
        """The half-widths (inputs,), in the input's own unit."""
        return np.ldexp(1.0, np.asarray(self.exponents))

    @property
    def units(self) -> list[str]:
        """The unit of every input."""
        return [self.unit(f.name) for f in self.layout.fields for _ in range(f.size)]

    def unit(self, field: str) -> str:
        """The unit of a field's inputs."""
        return "of its range" if field in self.scaled_fields else self.layout[field].unit

    def limit(self, field: str) -> float:
        """The half-width of a field's range, in its unit."""
        return 2.0 ** self.exponent[field]

    @property
    def declared(self) -> dict[str, float]:
        """The half-widths by field of the layout."""
        return {name: self.limit(name) for name in self.layout.names}

    def check(self, observations: np.ndarray) -> None:
        """Raise an ``InputError`` if observations (n, inputs) leave the box."""
        largest, limits = np.max(np.abs(observations), axis=0), self.declared
        sizes = {name: float(largest[self.layout.slice(name)].max()) for name in limits}
        beyond = {n: size for n, size in sizes.items() if not size <= limits[n] * ROUNDING}
        if beyond:
            problems = "; ".join(
                f"{name} reaches {size:.4g} {self.unit(name)}, declared +-{limits[name]:g}"
                for name, size in beyond.items()
            )
            options = " ".join(f"--range {n}={next_power(size):g}" for n, size in beyond.items())
            raise InputError(
                f"the policy's own flights leave the declared range: {problems}; declare {options}"
            )


def next_power(value: float) -> float:
    """The smallest power of two that is not below a value."""
    return 2.0 ** math.ceil(math.log2(value)) if 0 < value < math.inf else value


def declare(policy: Policy, overrides: dict[str, float] | None = None) -> InputBox:
    """The box of a policy: the ranges of its layout, and what overrides them by field.

    Raises:
        InputError: a field that the C cannot compute, an override of an unknown name, or a range
            that is not a power of two.
    """
    model = MODELS[policy.vehicle]
    without = set() if model.has_battery else {HIGHEST_RPM}
    without |= set() if model.disturbed else set(DISTURBANCES)
    fields = {name: f for name, f in fields_of(model).items() if name not in without}
    for field in policy.layout.fields:
        if field.name not in fields or fields[field.name].size != field.size:
            raise InputError(
                f"the policy observes {field.name!r} ({field.size} numbers), which has no C; "
                f"supported: {', '.join(f'{f.name} ({f.size})' for f in fields.values())}"
            )
    spans = {f.name: float(f.range) for f in policy.layout.fields}
    for name, value in (overrides or {}).items():
        if name not in spans:
            raise InputError(f"range {name}={value:g}: unknown name, allowed: {', '.join(spans)}")
        spans[name] = value
    ranges = {name: field.range for name, field in fields.items()} | spans
    for name, value in ranges.items():
        if not is_range(value):
            raise InputError(f"range {name}={value:g}: allowed: {POWER_OF_TWO}, such as 8 or 0.5")
    exponents = {name: math.frexp(value)[1] - 1 for name, value in ranges.items()}
    scaled_fields = (model.actuators.name, *DISTURBANCES, LAST_ACTION, HIGHEST_RPM)
    return InputBox(policy.layout, exponents, scaled_fields)


def next_gates(track: Track) -> dict[str, np.ndarray]:
    """The fields that depend only on the gate, (gates, size) float64 of each."""
    position = np.stack([np.asarray(c) for c in track.next_position.components()], 1)
    values = {
        "next_position": position,
        "next_yaw": np.asarray(track.next_yaw)[:, None],
        "next_yaw_unwrapped": np.asarray(unwrapped_turns(track))[:, None],
    }
    for count in GATES_AHEAD:
        place, yaw = gates_ahead(track, count)
        values[f"next{count}_position"] = np.asarray(place.array())
        values[f"next{count}_yaw"] = np.asarray(yaw)[:, None]
    return {name: value.astype(np.float64) for name, value in values.items()}


def track_ranges(layout: Layout, track: Track) -> dict[str, float]:
    """The ranges by field that a track needs where they are above those of the layout.

    At the start of a leg, the distance to its gate is about that between the two gates.
    """
    needed = {name: np.abs(value).max() for name, value in next_gates(track).items()}
    needed["position"] = 1.25 * needed["next_position"]
    return {
        name: next_power(size)
        for name, size in needed.items()
        if name in layout and size > layout[name].range
    }
