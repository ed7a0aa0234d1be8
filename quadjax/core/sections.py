"""The base of every config: pydantic sections filled from YAML, with one-line errors.

A config is a ``Section``; each key is declared once, with default, bounds and description::

    class Search(Section):
        "How trials are chosen."

        trials: int = Field(20, ge=1, le=10**6, description="number of trials")
        method: Literal["tpe", "random"] = Field("tpe", description="sampler")
        space: dict[str, Range] = Field({}, description="ranges by dotted config key")

        @model_validator(mode="after")
        def _check(self) -> "Search":          # a check of several keys: raise ValueError
            if ...:
                raise ValueError("search.trials is 3, allowed: at least 4 with method=tpe")
            return self

    search = load_section(Search, "mine.yaml", "sweeps", ["trials=2e3"])  # or InputError, one line
    text = to_yaml(search.model_dump())                                   # read_yaml reads it back

Sections are frozen and reject unknown keys. Types are strict: ``"1"`` and ``true`` are not numbers;
an ``int`` field takes ``2e6``, a ``tuple`` field takes a list (use ``tuple[float, ...]`` rather
than ``list``, so that sections stay hashable), a ``float`` field takes only finite numbers.
``X | None`` takes ``null``. A ``ValueError`` from a validator becomes the
message of the ``InputError``; start it with the dotted key. ``section.replace(key=value)`` is a
changed copy, validated again unless the values are arrays.
"""

import contextlib
import dataclasses
import operator
import re
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from numbers import Integral
from pathlib import Path
from typing import Annotated, Any, NoReturn, Self, TypeVar

import pydantic
from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    model_validator,
)
from pydantic.fields import FieldInfo
from pydantic_core import PydanticCustomError

from quadjax.core.errors import InputError, close_match, short
from quadjax.core.resources import find_config
from quadjax.core.section_keys import dotted, fields_at, keys_named
from quadjax.core.yaml_files import Tree, parse_overrides
from quadjax.core.yaml_layers import Layer, Sources, merge_layers, read_layers

__all__ = ["Field", "PrivateAttr", "Section", "validate", "load_section", "model_validator"]

LARGEST = 1e9  # default bound of numbers
MAX_LAPS, MAX_GATES, MAX_RUNS = 1000, 10_000, 100_000  # of one evaluation, simulated all at once
MAX_DRONES = 1000  # drones of one evaluation
MAX_SEED = 2**31 - 1
MAX_TEXT = 1000  # characters of a text
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Fraction = Annotated[float, Field(ge=0, le=1)]
FOLDER_NAME = r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}"
FolderName = Annotated[str, Field(pattern=rf"^{FOLDER_NAME}$")]
ALLOWED = {  # by the type of pydantic's error
    "bool_type": "true or false",
    "dict_type": "a mapping",
    "float_type": "a number",
    "int_type": "a whole number",
    "mapping_type": "a mapping",
    "model_type": "a mapping",
    "string_type": "text",
    "tuple_type": "a list",
}


def _pair(holds: Callable[[float, float], bool], allowed: str) -> AfterValidator:
    def check(ends: tuple[float, float]) -> tuple[float, float]:
        if not holds(*ends):
            raise PydanticCustomError("pair", f"Input should be {allowed}")
        return ends

    return AfterValidator(check)


ORDERED = _pair(operator.le, "[lowest, highest]")  # ``Annotated[tuple[float, float], ORDERED]``
RISING = _pair(operator.lt, "[lowest, a larger highest]")


def _null_at_zero(value: object) -> object:
    return None if value == 0 and not isinstance(value, bool) else value


# A number without an effect at 0, which is read as null: no body, no frames, ..
OffAtZero = Annotated[float | None, BeforeValidator(_null_at_zero)]


@dataclasses.dataclass(frozen=True)
class Unit:
    """The unit of a field's number, as in ``Annotated[float, Unit("m")]``.

    Attributes:
        name: ``m``, ``1/m``, ``1/s``, ``m/s``; ``steps``, time steps; ``decay``, a factor per time
            step; ``environments``, their number; ``gradient``, the largest one, per m.
    """

    name: str


@dataclasses.dataclass(frozen=True)
class Code:
    """Marks a field that may name code, as ``module:OBJECT``: ``Annotated[str, Code()]``.

    Attributes:
        mapping: the form of a mapping of such names, for messages.
    """

    mapping: str = "a mapping"


@dataclasses.dataclass(frozen=True)
class Needs:
    """Marks a field that has an effect only where another one of the config is set: not 0 or null.

    ``Annotated[float, Needs("rules.gate_frame")]``; ``quadjax.config.checks`` refuses another value
    than the default where it is not.
    """

    key: str


def unit_of(field: FieldInfo) -> str | None:
    """The unit that a field declares."""
    return next((item.name for item in field.metadata if isinstance(item, Unit)), None)


class BadValue(InputError):
    """A value of a key that is not allowed; the message starts with the key."""

    def __init__(self, key: str, message: str) -> None:
        """A message about the value of a dotted key."""
        super().__init__(message)
        self.key = key


def refuse(key: str, value: object, allowed: str) -> NoReturn:
    """Raise the one-line error of a value."""
    raise BadValue(key, f"{key} is {short(value)}, allowed: {allowed}")


class Section(pydantic.BaseModel):
    """A part of a config: frozen, without unknown keys, with strict types and finite numbers."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        validate_default=True,
        populate_by_name=True,
        hide_input_in_errors=True,
        str_max_length=MAX_TEXT,
    )
    IN_FILES: typing.ClassVar[Mapping[str, str]] = {}  # keys of files, and what names such a file

    if not typing.TYPE_CHECKING:  # type checkers derive the parameters from the fields

        def __init__(self, /, **values: object) -> None:
            """A section from its values.

            Raises:
                InputError: as ``validate``.
            """
            with one_line_errors(type(self).__name__), _errors_of(type(self), values, ""):
                super().__init__(**_plain(values))

        __init__.__pydantic_base_init__ = True  # validation of nested sections does not call it

    def replace(self, **changes: object) -> Self:
        """A copy with other values, validated as a whole.

        Of a section of arrays, such as ``params.reward`` of a race, the names alone are checked:
        the values are arrays, which may be traced.

        Raises:
            InputError: as ``validate``, of keys of this section.
        """
        schema = type(self)
        with one_line_errors(schema.__name__):
            if not any(hasattr(value, "dtype") for value in vars(self).values()):
                return self.with_values(changes)
            for name in changes.keys() - schema.model_fields.keys():
                raise _bad_value(schema, changes, [{"type": "extra_forbidden", "loc": (name,)}], "")
            return self.model_copy(update=changes)

    def with_values(self, changes: Mapping[str, object], prefix: str = "") -> Self:
        """As ``replace``; an error names the key alone, after ``prefix``, such as ``"motors."``.

        Raises:
            BadValue: a value that is not allowed.
        """
        fields = type(self).model_fields.items()
        values = {(field.alias or name): getattr(self, name) for name, field in fields}
        values |= changes
        with _errors_of(type(self), values, prefix):
            return type(self).model_validate(_plain(values))


SectionType = TypeVar("SectionType", bound=Section)


def validate(
    schema: type[SectionType], tree: Tree, source: str | Sources, prefix: str = ""
) -> SectionType:
    """A section from plain values.

    Args:
        schema: the section's class.
        tree: plain values, as ``read_yaml`` returns them.
        source: what to name in an error: the file, or the file of each key.
        prefix: of the keys in an error, such as ``"learner."``.

    Raises:
        InputError: one line: source, dotted key, value and what is allowed.
    """
    with one_line_errors(source), _errors_of(schema, tree, prefix):
        return schema.model_validate(_plain(tree))


def load_section(
    schema: type[SectionType], path: Path | str, folder: str, overrides: Sequence[str] = ()
) -> SectionType:
    """A section from a YAML file with its bases, and ``key=value`` overrides.

    Args:
        schema: the section's class.
        path: of the file, or a name in ``folder``.
        folder: the folder of ``configs/``.
        overrides: with dotted keys; values are read as YAML.

    Raises:
        InputError: an unknown key, a wrong type, an impossible value or an unreadable file.
    """
    path = find_config(path, folder)
    layers: list[Layer] = [*read_layers(path, folder), ("overrides", parse_overrides(overrides))]
    return validate(schema, *merge_layers(layers, path))


def check_integer(name: str, value: object, lowest: int, highest: int) -> None:
    """Raise an ``InputError`` that names the argument unless it is an integer in the range."""
    if (
        isinstance(value, bool)
        or not isinstance(value, Integral)
        or not lowest <= int(value) <= highest
    ):
        raise InputError(f"{name} is {value!r}, allowed: an integer, {lowest} to {highest}")


@contextlib.contextmanager
def one_line_errors(source: str | Sources) -> Iterator[None]:
    """Put the file of its key before the message of a ``BadValue`` in the block."""
    try:
        yield
    except BadValue as error:
        file = source if isinstance(source, str) else source.of(error.key)
        raise InputError(f"{file}: {error}") from None


@contextlib.contextmanager
def _errors_of(schema: type[Section], tree: Tree, prefix: str) -> Iterator[None]:
    """Raise ``BadValue`` for errors of pydantic in the block, of unknown keys first."""
    try:
        yield
    except pydantic.ValidationError as error:
        errors = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        raise _bad_value(schema, tree, [dict(e) for e in errors], prefix) from None
    except RecursionError:
        raise BadValue("", "nested too deep") from None


def _plain(value: Any) -> Any:
    """A value of YAML as its field takes it: a tuple for a list, 2000000 for 2e6."""
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    if type(value) in (list, tuple):
        return tuple(map(_plain, value))
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _bad_value(
    schema: type[Section], tree: Tree, errors: Sequence[Mapping[str, Any]], prefix: str
) -> BadValue:
    """The error of the first key among those of pydantic."""
    error, location = errors[0], _location(errors[0], tree)
    key = prefix + dotted(location) if location else prefix.rstrip(".")
    if error["type"] == "extra_forbidden":
        names = fields_at(schema, location[:-1])
        name, there = str(location[-1]), ", ".join(sorted(names))
        hint = close_match(name, list(names))
        if len(location) == 1 and (elsewhere := keys_named(schema, name)):
            hint = f"; did you mean {' or '.join(elsewhere[:3])}?"  # in a section that is left out
        if key in schema.IN_FILES:
            hint = f"; a file with this key is given as {schema.IN_FILES[key]}"
        return BadValue(key, f"unknown key {key}{hint}; allowed there: {there}")
    if error["type"] in ("value_error", "assertion_error"):
        reason = str(error["ctx"]["error"])
        first = re.split(r"[^\w.]", reason)[0]  # of a check of several keys: the one that it names
        message = reason if not key or key in reason else f"{key}: {reason}"
        return BadValue(first if first.startswith(key) else key, message)
    if error["type"] == "missing":
        return BadValue(key, f"{key} is missing")
    unit = _si_unit(schema, [key for key in location if isinstance(key, str)])
    texts = [_allowed(e, unit) for e in errors if _location(e, tree) == location]
    if error["type"] == "dict_type":
        field = fields_at(schema, location[:-1]).get(str(location[-1])) if location else None
        marks = [x for x in (field.metadata if field else ()) if isinstance(x, Code)]
        texts = [mark.mapping for mark in marks] or texts
    value = short(error["input"])
    if not key:
        return BadValue(key, f"{value} is not a mapping of keys to values")
    return BadValue(key, f"{key} is {value}, allowed: {' or '.join(dict.fromkeys(texts))}")


def _location(error: Mapping[str, Any], tree: object) -> tuple[str | int, ...]:
    """Keys and indices of an error, without the names of a union's members."""
    location: list[str | int] = []
    for step in error["loc"]:
        if isinstance(tree, Mapping) and step in tree:
            tree = tree[step]
        elif isinstance(tree, (list, tuple)) and isinstance(step, int) and step < len(tree):
            tree = tree[step]
        elif error["type"] != "missing" or step != error["loc"][-1]:
            continue
        location.append(step)
    return tuple(location)


def _si_unit(schema: type[Section], keys: Sequence[str]) -> str:
    """The unit of a key's number after a space, if it is one of physics."""
    field = fields_at(schema, keys[:-1]).get(keys[-1]) if keys else None
    unit = unit_of(field) if field else None
    return "" if unit in (None, "steps", "decay", "environments", "gradient") else f" {unit}"


def _allowed(error: Mapping[str, Any], unit: str) -> str:
    """What pydantic allows: "greater than 0 m", of "Input should be greater than 0"."""
    text, value = re.sub(r"^\w+ should (be |have )?", "", error["msg"]), error["input"]
    if error["type"] == "tuple_type" and isinstance(value, str) and len(value.split(",")) > 1:
        return f"a list: [{short(value)[1:-1]}]"
    text = ALLOWED.get(error["type"], text.partition(" after validation")[0])
    return text + unit if error["type"].startswith(("greater", "less")) else text
