"""Search spaces: which keys of a training config a sweep varies, and over what.

Each key is given as ``{choices: [..]}``, ``{range: [low, high]}`` or ``{log: [low, high]}``; a
range may have a ``step``, or ``points`` for a grid.
"""

import dataclasses
import json
import math
import types
import typing
from collections.abc import Mapping, Sequence

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError

Value = bool | int | float | str | list | dict | None
Params = dict[str, bool | int | float | str | None]  # what a store keeps: key -> plain value

WAYS = ("choices", "range", "log")
ENTRIES = (*WAYS, "step", "points")
OWN_KEYS = ("name", "seed", "train.devices", "train.tensorboard")  # what the sweep itself sets


@dataclasses.dataclass(frozen=True)
class Dimension:
    """One key of the config and the values that it may take."""

    key: str  # dotted
    kind: str  # "choices" | "float" | "int"
    low: float = 0.0
    high: float = 0.0
    log: bool = False
    step: float | None = None
    points: int | None = None  # of a grid
    choices: tuple[Value, ...] = ()

    def labels(self) -> list[bool | int | float | str | None]:
        """The choices as a store can keep them: lists and mappings as JSON text."""
        return [label_of(choice) for choice in self.choices]

    def value(self, plain: bool | int | float | str | None) -> Value:
        """The config's value for what the store keeps."""
        if self.kind != "choices":
            return plain
        return self.choices[self.labels().index(plain)]

    def holds(self, plain: bool | int | float | str | None) -> bool:
        """Whether the dimension has a value, as the store keeps it."""
        if self.kind == "choices":
            return plain in self.labels()
        return plain is not None and self.low <= plain <= self.high

    def plain(self, value: Value) -> bool | int | float | str | None:
        """A config's value as the store keeps it: in the words of the choice that equals it."""
        equal = [label_of(choice) for choice in self.choices if choice == value]
        return equal[0] if equal else label_of(value)

    def grid(self) -> list[bool | int | float | str | None]:
        """Every value of a grid, as the store keeps it.

        Raises:
            InputError: a range without ``step`` or ``points``.
        """
        if self.kind == "choices":
            return self.labels()
        if self.step is not None:
            count = int(math.floor((self.high - self.low) / self.step + 1e-9)) + 1
            values = [self.low + self.step * i for i in range(count)]
        elif self.points is not None:
            make = np.geomspace if self.log else np.linspace
            values = [float(x) for x in make(self.low, self.high, self.points)]
            values[0], values[-1] = self.low, self.high
        elif self.kind == "int" and not self.log:
            values = list(range(int(self.low), int(self.high) + 1))
        else:
            raise InputError(f"space.{self.key}: a grid needs choices, a step or points")
        if self.kind == "int":
            return sorted({round(value) for value in values})
        return values

    def ends(self) -> list[bool | int | float | str | None]:
        """Values that show whether the config takes the dimension: all choices, or both ends."""
        if self.kind == "choices":
            return self.labels()
        ends = [self.low, self.high]
        return [int(x) for x in ends] if self.kind == "int" else ends

    def draw(self, random: np.random.Generator) -> bool | int | float | str | None:
        """A value at random, for checking combinations."""
        if self.kind == "choices":
            return self.labels()[random.integers(len(self.choices))]
        if self.step is not None or self.kind == "int":
            width = self.step or 1
            count = int((self.high - self.low) / width + 1e-9)
            value = self.low + width * random.integers(count + 1)
            return int(value) if self.kind == "int" else float(value)
        return float(random.uniform(self.low, self.high))


def label_of(value: Value) -> bool | int | float | str | None:
    """A config's value as a store keeps it."""
    return json.dumps(value) if isinstance(value, (list, dict)) else value


def word(key: str, value: Value) -> str:
    """A ``key=value`` word of a command line."""
    return f"{key}={json.dumps(value)}"


def words_of(dimensions: Sequence[Dimension], params: Mapping[str, object]) -> list[str]:
    """The words that set a trial's parameters."""
    return [word(d.key, d.value(params[d.key])) for d in dimensions]


def flatten(tree: Mapping[str, object], stop: Sequence[str] = (), prefix: str = "") -> dict:
    """Dotted keys of a nested mapping.

    Args:
        tree: the mapping.
        stop: a mapping with any of these entries is a value, not a branch.
        prefix: of the keys.
    """
    flat = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        branch = isinstance(value, dict) and value and not any(entry in value for entry in stop)
        flat |= flatten(value, stop, f"{name}.") if branch else {name: value}
    return flat


def read_space(tree: object, algorithm: str, source: str) -> tuple[Dimension, ...]:
    """The dimensions of a sweep file's ``space``.

    Args:
        tree: mapping of (dotted or nested) keys to their values.
        algorithm: of the base config, for keys of the other learner, which change nothing.
        source: what to name in an error: the file.

    Raises:
        InputError: an unknown key, an empty range, a wrong type, by key.
    """
    if not isinstance(tree, dict) or not tree:
        raise InputError(f"{source}: space is {tree!r}, expected a mapping of keys to their values")
    flat = flatten(tree, ENTRIES)
    own_algorithm = "algorithm" in flat
    dimensions = []
    for key, given in flat.items():
        where = f"{source}: space.{key}"
        if key in OWN_KEYS:
            raise InputError(f"{where}: the sweep itself sets {key}")
        other = {"ppo": "shac", "shac": "ppo"}.get(algorithm)
        if not own_algorithm and key.split(".")[0] == other:
            raise InputError(f"{where}: changes nothing where algorithm is {algorithm}")
        dimensions.append(_dimension(key, given, _type_at(key, where), where))
    return tuple(dimensions)


def _type_at(key: str, where: str) -> object:
    """The type of a leaf of the config's schema."""
    kind: object = Config
    for part in key.split("."):
        if typing.get_origin(kind) is dict:
            kind = typing.get_args(kind)[1]
            continue
        hints = typing.get_type_hints(kind) if dataclasses.is_dataclass(kind) else {}
        if part not in hints:
            allowed = f"; allowed there: {', '.join(sorted(hints))}" if hints else ""
            raise InputError(f"{where}: unknown key{allowed}")
        kind = hints[part]
        if isinstance(kind, types.UnionType):
            kind = next(a for a in typing.get_args(kind) if a is not type(None))
    if dataclasses.is_dataclass(kind):
        inner = ", ".join(f"{key}.{name}" for name in typing.get_type_hints(kind))
        raise InputError(f"{where}: is a section; name one of its keys: {inner}")
    return kind


def _dimension(key: str, given: object, kind: object, where: str) -> Dimension:
    if not isinstance(given, dict):
        raise InputError(
            f"{where} is {given!r}, expected {{choices: [..]}}, {{range: [low, high]}} or "
            "{log: [low, high]}"
        )
    for entry in given:
        if entry not in ENTRIES:
            raise InputError(f"{where}: unknown entry {entry}; allowed: {', '.join(ENTRIES)}")
    ways = [way for way in WAYS if way in given]
    if len(ways) != 1:
        raise InputError(f"{where}: expected one of {', '.join(WAYS)}, found {len(ways)}")
    if ways == ["choices"]:
        return _choices(key, given, where)
    return _range(key, given, ways[0], kind, where)


def _choices(key: str, given: Mapping[str, object], where: str) -> Dimension:
    values = given["choices"]
    if "step" in given or "points" in given:
        raise InputError(f"{where}: choices take neither step nor points")
    if not isinstance(values, list) or not values:
        raise InputError(f"{where}: choices is {values!r}, expected a list of one value or more")
    seen: list[str] = []
    for value in values:
        text = json.dumps(value, default=str)
        if text in seen:
            raise InputError(f"{where}: {text} is there twice")
        seen.append(text)
    return Dimension(key, "choices", choices=tuple(values))


def _range(key: str, given: Mapping[str, object], way: str, kind: object, where: str) -> Dimension:
    if kind not in (int, float):
        raise InputError(f"{where}: is no number, so it takes no {way}: give choices")
    bounds = given[way]
    if not isinstance(bounds, list) or len(bounds) != 2 or not all(map(_is_number, bounds)):
        raise InputError(f"{where}: {way} is {bounds!r}, expected [lowest, highest], two numbers")
    low, high = bounds
    if low >= high:
        raise InputError(f"{where}: {way} [{low}, {high}] is empty, expected lowest < highest")
    if way == "log" and low <= 0:
        raise InputError(f"{where}: log begins at {low}, expected a positive number")
    step, points = given.get("step"), given.get("points")
    if step is not None and (way == "log" or not _is_number(step) or not 0 < step <= high - low):
        raise InputError(
            f"{where}: step is {step!r}, expected a positive number up to {high - low} of a range"
        )
    if points is not None and (not isinstance(points, int) or points < 2 or step is not None):
        raise InputError(f"{where}: points is {points!r}, expected a whole number from 2, no step")
    if kind is int:
        for value in (low, high, *([step] if step is not None else [])):
            if float(value) != int(value):
                raise InputError(f"{where}: {value} is not a whole number, which {key} is")
        step = None if step is None else int(step)
        return Dimension(key, "int", int(low), int(high), way == "log", step, points)
    return Dimension(key, "float", float(low), float(high), way == "log", step, points)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
