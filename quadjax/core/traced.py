"""Sections as pytrees: floats are leaves, which a program takes as numbers; the rest is static."""

import dataclasses
import types
import typing
from collections.abc import Collection, Iterable
from typing import Annotated, Any, TypeVar, cast

import jax
import jax.numpy as jnp
from pydantic.fields import FieldInfo

from quadjax.core.sections import Section

SectionType = TypeVar("SectionType", bound=Section)


@dataclasses.dataclass(frozen=True)
class Traced:
    """Marks a field of a whole number that is a leaf: ``Annotated[int, Traced()]``."""


@dataclasses.dataclass(frozen=True)
class UnusedAtZero:
    """Marks a field whose number is not used where it is 0; as a leaf it is None then."""


def register(section: type[SectionType]) -> type[SectionType]:
    """Register a section as a pytree whose leaves are its numbers.

    These are the fields of floats, of tuples and mappings of floats, and of whole numbers marked
    ``Traced``. The path of a leaf is the name of its field. A value of None has no leaf; a number
    marked ``UnusedAtZero`` may be None too, also where its type is float. The static part (sizes,
    flags, names) is compared as a whole: sections that differ in it are different programs.
    """
    leaves = _traced_names(section)
    static = [name for name in section.model_fields if name not in leaves]

    def flatten(value: SectionType) -> tuple[list, tuple]:
        children = [getattr(value, name) for name in leaves]
        return children, tuple(getattr(value, name) for name in static)

    def flatten_with_keys(value: SectionType) -> tuple[list, tuple]:
        children, fixed = flatten(value)
        keys = [jax.tree_util.GetAttrKey(name) for name in leaves]
        return list(zip(keys, children, strict=True)), fixed

    def unflatten(fixed: tuple, children: Iterable) -> SectionType:
        named = dict(zip(static, fixed, strict=True)) | dict(zip(leaves, children, strict=True))
        return cast(SectionType, section.model_construct(**named))

    jax.tree_util.register_pytree_with_keys(section, flatten_with_keys, unflatten, flatten)
    return section


def as_leaves(section: SectionType, scheduled: Collection[str] = ()) -> SectionType:
    """The section with its numbers as arrays (): float32, or int32 where ``Traced`` marks them.

    Args:
        section: of a registered class.
        scheduled: names of fields that are used also where they are 0.
    """
    fields = type(section).model_fields

    def leaves(name: str) -> Any:
        value = getattr(section, name)
        marked = UnusedAtZero() in fields[name].metadata and name not in scheduled
        return None if marked and value == 0.0 else jax.tree.map(_leaf, value)

    return with_leaves(section, **{name: leaves(name) for name in _traced_names(type(section))})


def _leaf(number: float) -> jax.Array:
    return jnp.asarray(number, jnp.int32 if isinstance(number, int) else jnp.float32)


def with_leaves(section: SectionType, **changes: Any) -> SectionType:
    """A copy of a section of leaves with other leaves, which are not validated."""
    return section.model_copy(update=changes)


def _traced_names(section: type[Section]) -> list[str]:
    return [name for name, field in section.model_fields.items() if _is_traced(field)]


def _is_traced(field: FieldInfo) -> bool:
    return _is_of_floats(field.annotation) or any(isinstance(x, Traced) for x in field.metadata)


def _is_of_floats(hint: Any) -> bool:
    """Whether a type is float, or a union, a tuple or a mapping to such, also with None."""
    if hint in (float, types.NoneType, Ellipsis):
        return hint is not types.NoneType
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        return _is_of_floats(inner[0])
    if origin is dict:
        return _is_of_floats(inner[1])
    if origin not in (tuple, types.UnionType, typing.Union):
        return False
    return all(_is_of_floats(option) for option in inner if option is not types.NoneType)
