"""Dotted keys of sections: the field of a key, its value, and a copy with another value."""

import typing
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, TypeGuard, TypeVar

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from quadjax.core.errors import InputError, close_match

SectionType = TypeVar("SectionType", bound=BaseModel)


def dotted(location: Sequence[str | int]) -> str:
    """A location as text: ``track.gates[0].size``."""
    parts = (f"[{step}]" if isinstance(step, int) else f".{step}" for step in location)
    return "".join(parts).removeprefix(".")


def fields_at(schema: type[BaseModel], location: Sequence[str | int] = ()) -> dict[str, FieldInfo]:
    """The fields, by key, of the section at a location; none where there is another value."""
    fields = {field.alias or name: field for name, field in schema.model_fields.items()}
    if not location:
        return fields
    key, *rest = location
    if str(key) not in fields:  # an index of a list, or a key of a mapping
        return fields_at(schema, rest)
    section = next(filter(is_section, _types(fields[str(key)].annotation)), None)
    return fields_at(section, rest) if section else {}


def keys_named(schema: type[BaseModel], name: str, depth: int = 4) -> list[str]:
    """The dotted keys of values in a schema and its sections whose last part is ``name``.

    A section may be of a subclass of its annotation: those of the default are known, too.
    """
    found = []
    for key, field in fields_at(schema).items() if depth else ():
        sections = [*filter(is_section, (*_types(field.annotation), type(field.default)))]
        for section in sections:
            found += [f"{key}.{path}" for path in keys_named(section, name, depth - 1)]
        found += [key] if key == name and not sections else []
    return list(dict.fromkeys(found))


def _types(hint: object) -> Iterator[object]:
    """The types in an annotation, inner ones too."""
    yield hint
    for inner in typing.get_args(hint):
        yield from _types(inner)


def is_section(hint: object) -> TypeGuard[type[BaseModel]]:
    """Whether an annotation is the class of a section."""
    return isinstance(hint, type) and issubclass(hint, BaseModel)


def value_at(section: BaseModel, key: str, missing: object = None) -> object:
    """A section's value of a dotted key; ``missing`` for one that a mapping does not list.

    Raises:
        InputError: no such key, or a section.
    """
    node: object = section
    parts = key.split(".")
    for index, step in enumerate(parts):
        if isinstance(node, Mapping):  # its keys may have dots
            return node.get(".".join(parts[index:]), missing)
        values = vars(node) if isinstance(node, BaseModel) else {}
        if step not in values:
            hint = close_match(step, list(values))
            raise InputError(f"{key}: unknown key{hint}; allowed there: {', '.join(values)}")
        node = values[step]
    if isinstance(node, BaseModel):
        raise InputError(f"{key}: is a section of the keys {', '.join(vars(node))}")
    return node


def with_value(section: SectionType, key: str, value: object) -> SectionType:
    """A section with another value at a dotted key; only that field is validated.

    Raises:
        InputError: no such key, or a value that is not allowed; the message starts with the key.
    """
    return _with_value(section, key.split("."), value)


def _with_value(node: Any, parts: Sequence[str], value: Any, prefix: str = "") -> Any:
    head, rest = parts[0], parts[1:]
    if isinstance(node, dict):
        return {**node, ".".join(parts): value}
    if rest:
        value = _with_value(getattr(node, head, {}), rest, value, f"{prefix}{head}.")
    return node.with_values({head: value}, prefix)
