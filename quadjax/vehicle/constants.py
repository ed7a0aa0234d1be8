"""Constants of a vehicle model: a dataclass whose fields declare unit, group and sign.

The dataclass is a ``flax.struct.PyTreeNode`` of scalars, so that each number can be traced and
drawn. A field of type ``Rotors`` has one number for each rotor. By name, as in configs and vehicle
files, the numbers of a field ``k_p`` are ``k_p1`` to ``k_p4``.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, cast

import jax
from flax import struct

from quadjax.core.vectors import Rotors

Kind = TypeVar("Kind")
KEY = "constant"


Sign = Literal["positive", "nonnegative", "direction", "any"]


@dataclasses.dataclass(frozen=True)
class Declaration:
    """What is declared of a constant.

    Attributes:
        unit: of the number.
        group: key of the config's section ``randomization`` that scales the constant. The group
            ``inertia`` is in the order x, y, z; the constants of the group ``lag`` are time
            constants, s.
        sign: that the number must have; a direction is 1 or -1.
        above: name of the constant that is the lower end of the range whose upper end this is:
            0 <= lower < upper.
    """

    unit: str = ""
    group: str | None = None
    sign: Sign = "any"
    above: str | None = None


def constant(
    unit: str = "", group: str | None = None, sign: Sign = "any", above: str | None = None
) -> Any:
    """A field of a dataclass of constants; see ``Declaration``."""
    return struct.field(metadata={KEY: Declaration(unit, group, sign, above)})


@functools.cache
def declarations(kind: type) -> dict[str, Declaration]:
    """What is declared of each constant of a dataclass, by name and in order."""
    declared: dict[str, Declaration] = {}
    for field in dataclasses.fields(kind):
        names = rotor_names(field.name) if field.type is Rotors else (field.name,)
        declared |= dict.fromkeys(names, field.metadata.get(KEY, Declaration()))
    return declared


def rotor_names(name: str) -> tuple[str, ...]:
    """The names of a constant's four numbers, in the order of ``Rotors``."""
    return tuple(f"{name}{rotor}" for rotor in (1, 2, 3, 4))


def constant_names(kind: type) -> tuple[str, ...]:
    """The names of the constants of a dataclass, in order."""
    return tuple(declarations(kind))


def from_values(kind: type[Kind], values: Mapping[str, Any]) -> Kind:
    """The constants of a dataclass with numbers by name."""
    numbers: dict[str, Any] = {}
    for field in dataclasses.fields(cast(Any, kind)):
        if field.type is Rotors:
            numbers[field.name] = Rotors(*(values[name] for name in rotor_names(field.name)))
        else:
            numbers[field.name] = values[field.name]
    return kind(**numbers)


def values_of(constants: Any) -> dict[str, Any]:
    """The numbers of constants by name."""
    names = constant_names(type(constants))
    return dict(zip(names, jax.tree.leaves(constants), strict=True))


def replaced(constants: Kind, values: Mapping[str, Any]) -> Kind:
    """Constants of which some numbers, given by name, are replaced."""
    return from_values(type(constants), values_of(constants) | dict(values))
