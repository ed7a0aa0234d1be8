"""Sections as pytrees: floats are leaves, which a program takes as numbers; the rest is static."""

import types
import typing
from collections.abc import Iterable
from typing import Annotated, Any, TypeVar, cast

import jax
import jax.numpy as jnp

from quadjax.core.sections import Section

SectionType = TypeVar("SectionType", bound=Section)


def register(
    section: type[SectionType], *, whole_numbers: tuple[str, ...] = ()
) -> type[SectionType]:
    """Register a section as a pytree whose leaves are its numbers.

    These are the fields of floats, of tuples and mappings of floats, and the named ones of
    ``whole_numbers``. The path of a leaf is the name of its field. A value of None has no leaf. The
    static part (sizes, flags, names) is compared as a whole: sections that differ in it are
    different programs.
    """
    fields = section.model_fields.items()
    assert set(whole_numbers) <= section.model_fields.keys(), whole_numbers
    leaves = [k for k, x in fields if k in whole_numbers or _is_of_floats(x.annotation)]
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


def as_leaves(section: SectionType) -> SectionType:
    """A registered section with its numbers as arrays (): int32 for whole ones, else float32."""
    return jax.tree.map(_leaf, section)


def _leaf(number: float) -> jax.Array:
    return jnp.asarray(number, jnp.int32 if isinstance(number, int) else jnp.float32)


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
