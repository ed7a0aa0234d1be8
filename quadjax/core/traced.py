"""Sections as pytrees: floats are leaves, which a program takes as numbers; the rest is static."""

from typing import TypeVar, cast

import jax
import jax.numpy as jnp

from quadjax.core.sections import Section

SectionType = TypeVar("SectionType", bound=Section)


def register(section: type[SectionType]) -> type[SectionType]:
    """Register a section as a pytree whose leaves are its fields of type ``float``.

    A field that is ``float | None`` is a leaf unless it is None. The static part (sizes, flags,
    names) is compared as a whole: sections that differ in it are different programs.
    """
    leaves = [n for n, f in section.model_fields.items() if f.annotation in (float, float | None)]
    static = [n for n in section.model_fields if n not in leaves]

    def flatten(value: SectionType) -> tuple[list, tuple]:
        children = [getattr(value, name) for name in leaves]
        return children, tuple(getattr(value, name) for name in static)

    def unflatten(fixed: tuple, children: list) -> SectionType:
        named = dict(zip(static, fixed, strict=True)) | dict(zip(leaves, children, strict=True))
        return cast(SectionType, section.model_construct(**named))

    jax.tree_util.register_pytree_node(section, flatten, unflatten)
    return section


def as_leaves(section: SectionType) -> SectionType:
    """The section with its floats as single-precision arrays ()."""
    return cast(SectionType, jax.tree.map(jnp.float32, section))
