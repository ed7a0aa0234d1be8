"""Dataclass configs through OmegaConf: for the packages that do not yet use ``config.base``."""

import dataclasses
import types
import typing
from typing import TypeVar

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from quadjax.config.files import Tree, read_tree_with_bases
from quadjax.core.errors import InputError

Schema = TypeVar("Schema")
read_yaml_with_base = read_tree_with_bases


def fill(schema: type[Schema], tree: Tree, source: str) -> Schema:
    """An instance of a dataclass schema, filled from plain values by OmegaConf.

    Args:
        schema: a (nested) dataclass with defaults.
        tree: plain dictionaries, lists and values.
        source: what to name in an error: the file.

    Raises:
        InputError: an unknown key or a value of the wrong type.
    """
    _check_keys(schema, tree, source, "")
    try:
        merged = OmegaConf.merge(_open(OmegaConf.structured(schema)), OmegaConf.create(tree))
        return OmegaConf.to_object(merged)
    except OmegaConfBaseException as error:
        key = getattr(error, "full_key", None) or "?"
        reason = str(error.msg if hasattr(error, "msg") else error).splitlines()[0]
        raise InputError(f"{source}: {key}: {reason}") from error


def _open(node: DictConfig) -> DictConfig:
    """Let a frozen dataclass's nodes be merged into."""
    OmegaConf.set_readonly(node, False)
    for key in node:
        child = node._get_node(key)
        if isinstance(child, DictConfig):
            _open(child)
    return node


def _check_keys(schema: type, tree: object, source: str, prefix: str) -> None:
    """Refuse unknown keys with the list of allowed ones, before OmegaConf sees them."""
    hints = typing.get_type_hints(schema)
    if not isinstance(tree, dict):
        raise InputError(f"{source}: {prefix.rstrip('.') or 'config'}: {tree!r} is not a mapping")
    for key, value in tree.items():
        if key not in hints:
            raise InputError(
                f"{source}: unknown key {prefix}{key}; allowed there: {', '.join(sorted(hints))}"
            )
        kind = _plain(hints[key])
        if value is None and kind is not hints[key]:
            continue
        _check_value(kind, value, source, f"{prefix}{key}")
        tree[key] = _as_meant(kind, value)
        if dataclasses.is_dataclass(kind):
            _check_keys(kind, value, source, f"{prefix}{key}.")
        elif isinstance(value, list):
            _check_items(kind, value, source, f"{prefix}{key}")


def _check_value(kind: object, value: object, source: str, name: str) -> None:
    """Refuse what OmegaConf would pass over or answer without naming the key."""
    container = typing.get_origin(kind)
    if container in (list, dict) and not isinstance(value, container):
        wanted = "list" if container is list else "mapping"
        raise InputError(f"{source}: {name}: {value!r} is not a {wanted}")
    if container is dict and typing.get_args(kind)[1:] == (float,):
        for key, number in value.items():
            if isinstance(number, bool) or not isinstance(number, (int, float)):
                raise InputError(f"{source}: {name}.{key} is {number!r}, expected a number")
    if value == "???":
        raise InputError(f"{source}: {name} is '???', expected a value")


def _as_meant(kind: object, value: object) -> object:
    """A value as its field's type takes it: YAML reads true as a truth value, 2e6 as a float."""
    if kind is str and isinstance(value, bool):
        return str(value).lower()
    if kind is int and isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def _check_items(kind: object, values: list, source: str, name: str) -> None:
    inner = [_plain(argument) for argument in typing.get_args(kind)]
    for index, value in enumerate(values):
        if inner and dataclasses.is_dataclass(inner[0]):
            _check_keys(inner[0], value, source, f"{name}[{index}].")
        elif inner and inner[0] in (int, float):
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise InputError(f"{source}: {name}[{index}] is {value!r}, expected a number")


def _plain(hint: object) -> object:
    """The type under an ``| None``."""
    if isinstance(hint, types.UnionType):
        return next(a for a in typing.get_args(hint) if a is not type(None))
    return hint
