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

    tree = merge_trees(read_tree_with_bases(path), parse_overrides(["trials=2e3"]))
    search = build(Search, tree, str(path))   # or InputError, one line
    text = to_yaml(search.model_dump())       # read_yaml reads it back

Sections are frozen and refuse unknown keys. Types are strict: ``"1"`` and ``true`` are not numbers;
an ``int`` field takes ``2e6``, a ``tuple`` field takes a list (use ``tuple[float, ...]`` rather
than ``list``, so that sections stay hashable), a ``float`` field takes only numbers that are finite
in single precision. ``X | None`` takes ``null``. A ``ValueError`` from a validator becomes the
message of the ``InputError``; start it with the dotted key. ``section.replace(key=value)`` is a
changed copy, validated again.
"""

import contextlib
import dataclasses
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, NoReturn, Self, TypeGuard, TypeVar

import pydantic
from pydantic import ConfigDict, Field, model_validator
from pydantic.fields import FieldInfo

from quadjax.core.errors import InputError
from quadjax.core.layers import Layer, from_layers
from quadjax.core.resources import find_config
from quadjax.core.yaml_files import (
    Tree,
    close_match,
    merge_trees,
    parse_overrides,
    read_tree_with_bases,
    short,
)

LARGEST = 1e9  # default bound of numbers
MAX_TEXT = 1000  # characters of a text
Positive = Annotated[float, Field(gt=0, le=LARGEST)]
NonNegative = Annotated[float, Field(ge=0, le=LARGEST)]
Fraction = Annotated[float, Field(ge=0, le=1)]
FOLDER_NAME = r"[A-Za-z0-9_][A-Za-z0-9._-]{0,99}"
FolderName = Annotated[str, Field(pattern=rf"^{FOLDER_NAME}$")]

_UNION_TAG = re.compile(r"int|float|str|bool|(literal|tuple|constrained|function)\b.*")
MIN_FLOAT, MAX_FLOAT = 1.2e-38, 3.4e38  # single precision


@dataclasses.dataclass(frozen=True)
class Unit:
    """The unit of a field's number, as in ``Annotated[float, Unit("m")]``.

    Attributes:
        name: ``m``, ``1/m``, ``1/s``, ``m/s``; ``steps``, time steps; ``decay``, a factor per time
            step; ``environments``, their number.
    """

    name: str


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
    )

    if not typing.TYPE_CHECKING:  # type checkers derive the parameters from the fields

        def __init__(self, /, **values: object) -> None:
            """A section from its values.

            Raises:
                InputError: as ``build``.
            """
            with _one_line_errors(type(self), values, type(self).__name__):
                super().__init__(**values)

        __init__.__pydantic_base_init__ = True  # validation of nested sections does not call it

    @model_validator(mode="before")
    @classmethod
    def _coerce_values(cls, values: object) -> object:
        if not isinstance(values, Mapping):
            return values
        hints = {(f.alias or name): f.annotation for name, f in cls.model_fields.items()}
        return {key: _coerce(hints.get(key), value) for key, value in values.items()}

    def replace(self, **changes: object) -> Self:
        """A copy with other values, validated as a whole.

        Raises:
            InputError: as ``build``.
        """
        known = {
            (f.alias or name): getattr(self, name) for name, f in type(self).model_fields.items()
        }
        return build(type(self), {**known, **changes}, type(self).__name__)


SectionType = TypeVar("SectionType", bound=Section)


def _options(hint: object) -> tuple[object, ...]:
    """The members of a union, or the type itself."""
    if typing.get_origin(hint) is typing.Annotated:
        hint = typing.get_args(hint)[0]
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        return typing.get_args(hint)
    return (hint,)


def _coerce(hint: object, value: object) -> object:
    """A value as YAML gives it, as its field takes it: 2e6 to an int, a list to a tuple."""
    options = _options(hint)
    if isinstance(value, float) and float not in options and int in options:
        return int(value) if value.is_integer() else value
    if isinstance(value, list):
        for option in options:
            if typing.get_origin(option) is tuple:
                inner = typing.get_args(option)[0]
                return tuple(_coerce(inner, item) for item in value)
    return value


def build(schema: type[SectionType], tree: Tree, source: str, prefix: str = "") -> SectionType:
    """A section from plain values.

    Args:
        schema: the section's class.
        tree: plain values, as ``read_yaml`` returns them.
        source: what to name in an error: the file.
        prefix: of the keys in an error, such as ``"learner."``.

    Raises:
        InputError: one line: source, dotted key, value and what is allowed.
    """
    with _one_line_errors(schema, tree, source, prefix):
        return schema.model_validate(tree)


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
    tree, over = read_tree_with_bases(path), parse_overrides(overrides)
    with from_layers([Layer(str(path), tree), Layer("overrides", over)], str(path)):
        return build(schema, merge_trees(tree, over), str(path))


@contextlib.contextmanager
def _one_line_errors(
    schema: type[Section], tree: Tree, source: str, prefix: str = ""
) -> Iterator[None]:
    """Check the tree's values, and raise ``InputError`` for errors of pydantic in the block."""
    _check_values(tree, source, prefix)
    try:
        yield
    except pydantic.ValidationError as error:
        errors = sorted(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        raise InputError(f"{source}: {_message(schema, errors[0], prefix)}") from None
    except RecursionError:
        raise InputError(f"{source}: nested too deep") from None


def _refuse_long(text: str, source: str, key: str) -> NoReturn:
    raise InputError(f"{source}: {key} has {len(text)} characters, allowed: up to {MAX_TEXT}")


def _check_values(value: object, source: str, key: str) -> None:
    """Reject numbers outside the range of single precision, and long texts."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            if len(str(name)) > MAX_TEXT:
                _refuse_long(str(name), source, f"a key of {key.rstrip('.')}")
            _check_values(item, source, f"{key}{name}.")
    elif isinstance(value, str) and len(value) > MAX_TEXT:
        _refuse_long(value, source, key.rstrip("."))
    elif isinstance(value, (list, tuple)):
        for item in value:
            _check_values(item, source, key)
    elif isinstance(value, (int, float)) and value and not MIN_FLOAT <= abs(value) <= MAX_FLOAT:
        raise InputError(
            f"{source}: {key.rstrip('.')} is {short(value)}, allowed: finite numbers in the range "
            "of single precision"
        )


def _message(schema: type[Section], error: Mapping, prefix: str) -> str:
    location = tuple(part for part in error["loc"] if not _UNION_TAG.fullmatch(str(part)))
    *parents, last = location or ("",)
    dotted = prefix + _dotted(location) if location else prefix.rstrip(".")
    if error["type"] == "extra_forbidden":
        names = _keys(_section_of(_at(schema, parents)[0]) or schema)
        there = f"allowed there: {', '.join(sorted(names))}"
        return f"unknown key {dotted}{close_match(str(last), names)}; {there}"
    if error["type"] in ("value_error", "assertion_error"):
        reason = str(error["ctx"]["error"])
        return reason if not dotted or dotted in reason else f"{dotted}: {reason}"
    field = _at(schema, location)[1]
    text = allowed(field) if field is not None else error["msg"]
    if error["type"] == "missing":
        return f"{dotted} is missing, allowed: {text}"
    if error["type"] == "too_long" and short(error["input"]).endswith("..."):
        return f"{dotted} has {len(error['input'])} items, allowed: {text}"
    if not dotted:
        return f"{short(error['input'])} is not a mapping of keys to values"
    return f"{dotted} is {short(error['input'])}, allowed: {text}"


def _dotted(location: tuple[str | int, ...]) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _keys(schema: type[Section]) -> list[str]:
    return [field.alias or name for name, field in schema.model_fields.items()]


def _at(schema: type[Section], location: Sequence) -> tuple[object, FieldInfo | None]:
    """The type at an error's location, and the field of the last key on the way."""
    hint: Any = schema
    field: FieldInfo | None = None
    for part in location:
        section = _section_of(hint)
        if section is not None and isinstance(part, str):
            found = [f for name, f in section.model_fields.items() if part in (name, f.alias)]
            field = found[0] if found else None
            hint = field.annotation if field else None
        else:  # an item of a list or a value of a mapping
            inner = [a for option in _options(hint) for a in typing.get_args(option)]
            hint = next((a for a in reversed(inner) if a not in (Ellipsis, type(None))), hint)
    return hint, field


def number_unit(schema: type[Section], location: Sequence) -> tuple[bool, str | None]:
    """Whether the key at a location takes numbers, and the name of their unit, if it has one.

    Args:
        schema: of the location's first key.
        location: keys of sections and mappings, and indices of lists.
    """
    hint, field = _at(schema, location)
    kinds = {getattr(option, "__origin__", option) for option in _options(hint)}
    units = [item.name for item in (field.metadata if field else ()) if isinstance(item, Unit)]
    return not kinds.isdisjoint((int, float)), units[0] if units else None


def _section_of(hint: object) -> type[Section] | None:
    return next((option for option in _options(hint) if _is_section(option)), None)


def _is_section(hint: object) -> TypeGuard[type[Section]]:
    return isinstance(hint, type) and issubclass(hint, Section)


def allowed(field: FieldInfo) -> str:
    """The values that a field takes, as text: ``"a whole number from 1 to 4096, or null"``."""
    options = [option for option in _options(field.annotation) if option is not type(None)]
    own = [getattr(o, "__metadata__", (None,))[0] for o in options]  # a Field of one option
    texts = [_type_text(o) + (_bounds(f) if f else "") for o, f in zip(options, own, strict=True)]
    text = " or ".join(texts) + _bounds(field)
    return f"{text}, or null" if len(options) < len(_options(field.annotation)) else text


def _type_text(hint: object, plural: bool = False) -> str:
    if typing.get_origin(hint) is typing.Annotated:
        hint = typing.get_args(hint)[0]
    if typing.get_origin(hint) is Literal:
        return "one of " + ", ".join(str(choice) for choice in typing.get_args(hint))
    inner = typing.get_args(hint)
    if typing.get_origin(hint) in (tuple, list):
        count = f"{len(inner)} " if inner[-1] is not Ellipsis and len(inner) > 1 else ""
        bounds = getattr(inner[0], "__metadata__", None)
        each = _bounds(bounds[0]).replace(", ", ", each ", 1) if bounds else ""
        return f"a list of {count}{_type_text(inner[0], plural=True)}{each}"
    if typing.get_origin(hint) is dict:
        return f"a mapping of names to {_type_text(inner[-1], plural=True)}"
    names: dict[Any, tuple[str, str]] = {
        bool: ("true or false", "true or false"),
        int: ("a whole number", "whole numbers"),
        float: ("a number", "numbers"),
        str: ("text", "texts"),
    }
    default = ("a mapping", "mappings") if _is_section(hint) else ("a value", "values")
    return names.get(hint, default)[plural]


def _bounds(field: FieldInfo) -> str:
    bounds, counts = [], []
    for item in field.metadata:
        for name, text in (("ge", "at least"), ("gt", "above"), ("le", "at most"), ("lt", "below")):
            if (bound := getattr(item, name, None)) is not None:
                bounds.append(f"{text} {_number(bound)}")
        for name, text in (("min_length", "at least"), ("max_length", "at most")):
            if (bound := getattr(item, name, None)) is not None:
                counts.append(f"{text} {bound}")
        if getattr(item, "pattern", None):
            bounds.append(f"matching {item.pattern}")
    if counts:
        bounds.append(f"{', '.join(counts)} of them")
    return "".join(f", {bound}" for bound in bounds)


def _number(bound: float) -> str:
    return (
        f"{bound:g}".replace("e+0", "e").replace("e+", "e")
        if abs(bound) in {1e5, 1e6, 1e7, 1e8, 1e9, 1e12}
        else str(bound)
    )


def value_at(section: Section, key: str, missing: object = 1.0) -> object:
    """A section's value of a dotted key; ``missing`` for a factor that a mapping does not list.

    Raises:
        InputError: no such key, or a section.
    """
    node: object = section
    parts = key.split(".")
    for index, part in enumerate(parts):
        rest = ".".join(parts[index:])
        if isinstance(node, Mapping) and (rest in node or ":" in rest):  # "module.of.mine:function"
            return node.get(rest, missing)
        known = node if isinstance(node, Mapping) else getattr(node, "__dict__", {})
        if part not in known and not isinstance(node, Mapping):
            hint = close_match(part, list(known))
            raise InputError(f"{key}: unknown key{hint}; allowed there: {', '.join(known)}")
        node = known.get(part, missing)
    if isinstance(node, Section):
        raise InputError(f"{key}: is a section of the keys {', '.join(vars(node))}")
    return node


class KeyInfo(NamedTuple):
    """One key of a config: dotted name, values it takes, default and description."""

    key: str
    allowed: str
    default: object
    description: str


def describe(schema: type[Section], prefix: str = "") -> list[KeyInfo]:
    """Every key of a section and of those in it, in order, for help and reference pages."""
    found: list[KeyInfo] = []
    for name, field in schema.model_fields.items():
        key = f"{prefix}{field.alias or name}"
        if _is_section(field.annotation):
            found += describe(field.annotation, f"{key}.")
        else:
            default = None if field.is_required() else field.get_default(call_default_factory=True)
            found.append(KeyInfo(key, allowed(field), default, field.description or ""))
    return found
