"""The box of inputs that a fixed-point policy is declared for: one power of two per input."""

import dataclasses
import math

import numpy as np

from quadjax.core.errors import InputError
from quadjax.policy.file import Policy

# Numbers of each field that the exported C can compute.
PLAIN = {
    "position": 3,
    "velocity": 3,
    "attitude": 3,
    "rates": 3,
    "next_position": 3,
    "next_yaw": 1,
    "next_yaw_unwrapped": 1,
}
SCALED = {"rpm": 4, "thrust": 1, "moment_ext": 3, "force_ext": 1}  # to [-1, 1] over their spans
POSE = ("position", "velocity", "attitude", "rates", "next_position")
NEEDED = {"motor": (*POSE, "rpm", "moment_ext", "force_ext"), "rate": (*POSE, "thrust")}
SMALLEST, LARGEST = 2.0**-20, 2.0**20


@dataclasses.dataclass(frozen=True)
class InputBox:
    """Symmetric ranges ``+-2**exponent`` of every input, and what each is called."""

    names: tuple[str, ...]
    exponents: tuple[int, ...]
    units: tuple[str, ...]

    @property
    def ranges(self) -> np.ndarray:
        """The half-widths (inputs,), in the input's own unit."""
        return np.ldexp(1.0, np.asarray(self.exponents))

    def outside(self, observations: np.ndarray) -> list[str]:
        """What leaves the box, one line per input, of observations (n, inputs)."""
        largest = np.max(np.abs(observations), axis=0)
        groups: dict[str, float] = {}
        for name, value, limit in zip(self.names, largest, self.ranges, strict=True):
            if not value <= limit:
                group = name.split("[")[0]
                groups[group] = max(groups.get(group, 0.0), float(value))
        return [
            f"{group} reaches {value:.4g} {self.units[self.index(group)]}, declared "
            f"+-{self.ranges[self.index(group)]:g}"
            for group, value in groups.items()
        ]

    @property
    def groups(self) -> tuple[str, ...]:
        """The fields of the observation, in order."""
        return tuple(dict.fromkeys(name.split("[")[0] for name in self.names))

    def columns(self, group: str) -> list[int]:
        """The indices of a field's inputs."""
        return [i for i, name in enumerate(self.names) if name.split("[")[0] == group]

    def index(self, group: str) -> int:
        """The index of a field's first input."""
        return self.columns(group)[0]

    def exponent(self, group: str) -> int:
        """The exponent of a field's range."""
        return self.exponents[self.index(group)]

    def limit(self, group: str) -> float:
        """The half-width of a field's range, in its unit."""
        return 2.0 ** self.exponent(group)


def power_of_two(name: str, value: float) -> int:
    """The exponent of a range that must be a power of two.

    Raises:
        InputError: it is not, or not between 2^-20 and 2^20.
    """
    if not SMALLEST <= value <= LARGEST or math.frexp(value)[0] != 0.5:
        raise InputError(
            f"range {name}={value:g}: expected a power of two between 2^-20 and 2^20, "
            "such as 8 or 0.5"
        )
    return math.frexp(value)[1] - 1


def declare(policy: Policy, overrides: dict[str, float] | None = None) -> InputBox:
    """The box of a policy: the ranges of its layout, and what overrides them by field.

    Raises:
        InputError: a field that the C cannot compute or lacks, an override of an unknown name, or
            a range that is not a power of two.
    """
    fields = policy.layout.fields
    for field in fields:
        if (PLAIN | SCALED).get(field.name) != field.size:
            raise InputError(
                f"the policy observes {field.name!r} ({field.size} numbers), which has no C; "
                f"supported: {', '.join(f'{n} ({k})' for n, k in (PLAIN | SCALED).items())}"
            )
    missing = [name for name in NEEDED[policy.vehicle] if name not in policy.layout]
    if missing:
        raise InputError(f"the policy does not observe {missing[0]!r}, which the exported C needs")
    ranges = {field.name: float(field.range) for field in fields}
    for name, value in (overrides or {}).items():
        if name not in ranges:
            raise InputError(f"range {name}={value:g}: unknown name, allowed: {list(ranges)}")
        ranges[name] = value
    exponents = {name: power_of_two(name, value) for name, value in ranges.items()}
    sizes = [field for field in fields for _ in range(field.size)]
    return InputBox(
        names=policy.layout.labels,
        exponents=tuple(exponents[field.name] for field in sizes),
        units=tuple("of its range" if f.name in SCALED else f.unit for f in sizes),
    )


def parse_overrides(options: list[str]) -> dict[str, float]:
    """``["position=16", ..]`` as a mapping.

    Raises:
        InputError: an option that is not ``name=number``.
    """
    overrides = {}
    for option in options:
        name, _, value = option.partition("=")
        try:
            overrides[name] = float(value)
        except ValueError:
            raise InputError(
                f"range {option!r}: expected name=number, such as position=16"
            ) from None
    return overrides
