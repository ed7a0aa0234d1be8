"""The box of inputs that a fixed-point policy is declared for: one power of two per input."""

import dataclasses
import math

import numpy as np

from quadjax.core.errors import InputError
from quadjax.policy.file import Policy

# What the inputs of a policy are, in order: name and how many numbers.
LAYOUT = {
    "motor": (
        ("position", 3),
        ("velocity", 3),
        ("attitude", 3),
        ("rates", 3),
        ("rpm", 4),
        ("next_position", 3),
        ("next_yaw", 1),
        ("moment_ext", 3),
        ("force_ext", 1),
    ),
    "rate": (
        ("position", 3),
        ("velocity", 3),
        ("attitude", 3),
        ("rates", 3),
        ("thrust", 1),
        ("next_position", 3),
        ("next_yaw", 1),
    ),
}
UNITS = {
    "position": "m",
    "velocity": "m/s",
    "attitude": "rad",
    "rates": "rad/s",
    "rpm": "of its range",
    "thrust": "of its range",
    "next_position": "m",
    "next_yaw": "rad",
    "moment_ext": "of its range",
    "force_ext": "of its range",
}
DEFAULTS = {
    "position": 8.0,
    "velocity": 16.0,
    "attitude": 4.0,
    "rates": 16.0,
    "rpm": 2.0,
    "thrust": 2.0,
    "next_position": 8.0,
    "next_yaw": 4.0,
    "moment_ext": 2.0,
    "force_ext": 2.0,
}
SMALLEST, LARGEST = 2.0**-20, 2.0**20


@dataclasses.dataclass(frozen=True)
class InputBox:
    """Symmetric ranges ``+-2**exponent`` of every input, and what each is called."""

    names: tuple[str, ...]
    exponents: tuple[int, ...]

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
            f"{group} reaches {value:.4g} {UNITS[group]}, declared "
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
    """The box of a policy: the defaults, and what overrides them by the name of the inputs.

    Where the policy was trained on a next-gate yaw that is not wrapped (its observation says
    ``wrap_next_yaw: false``), that input's default is 8 rad.

    Raises:
        InputError: an override of an unknown name or that is not a power of two.
    """
    layout = LAYOUT[policy.vehicle]
    ranges = {name: DEFAULTS[name] for name, _ in layout}
    if policy.observation.get("wrap_next_yaw") is False:
        ranges["next_yaw"] = 8.0
    for name, value in (overrides or {}).items():
        if name not in ranges:
            raise InputError(f"range {name}={value:g}: unknown name, allowed: {list(ranges)}")
        ranges[name] = value
    names, exponents = [], []
    for name, count in layout:
        exponent = power_of_two(name, ranges[name])
        names += [f"{name}[{i}]" if count > 1 else name for i in range(count)]
        exponents += [exponent] * count
    return InputBox(tuple(names), tuple(exponents))


def parse_overrides(words: list[str]) -> dict[str, float]:
    """``["position=16", ..]`` as a mapping.

    Raises:
        InputError: a word that is not ``name=number``.
    """
    overrides = {}
    for word in words:
        name, _, value = word.partition("=")
        try:
            overrides[name] = float(value)
        except ValueError:
            raise InputError(f"range {word!r}: expected name=number, such as position=16") from None
    return overrides
