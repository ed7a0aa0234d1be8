"""Configs: frozen dataclasses are the schema, YAML files and ``key=value`` words fill them.

A config file may name another as ``base``; ``vehicle.file`` and ``track.file`` name files of
``configs/vehicles`` and ``configs/tracks``, whose values the config may override key by key.
Whatever is wrong is one ``InputError`` that names the key, the value and what is allowed.
"""

import dataclasses
import re
import types
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from quadjax.config.checks import check
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS

Schema = TypeVar("Schema")
Tree = dict[str, object]


def load_config(path: Path | str, words: Sequence[str] = ()) -> Config:
    """The config of a YAML file and ``key=value`` words, complete and checked.

    Raises:
        InputError: an unknown key, a wrong type, an impossible value or an unreadable file.
    """
    tree = merge_trees(read_yaml_with_base(path), parse_words(words))
    tree = _with_file(tree, "vehicle", _vehicle_values, Path(path).parent)
    tree = _with_file(tree, "track", _track_values, Path(path).parent)
    config = fill(Config, tree, str(path))
    check(config)
    return config


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


class _Loader(yaml.SafeLoader):
    """YAML in which 1e-3 is a number, as everybody expects, and a key given twice is an error."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> Tree:
        seen: set[object] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.constructor.ConstructorError(
                    None, None, "a key is not a plain word", key_node.start_mark
                )
            if key_node.tag == "tag:yaml.org,2002:merge":
                continue
            key = self.construct_object(key_node, deep=True)
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key!r} is given twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"^[-+]?(\d[\d_]*\.?[\d_]*|\.\d[\d_]*)[eE][-+]?\d+$"),
    list("-+0123456789."),
)
# YAML 1.1 takes on, off, yes and no for truth values; here some are choices: residual.mirror. A key
# that is true or false understands them all the same.
for _letter in "yYnNoO":
    _Loader.yaml_implicit_resolvers[_letter] = [
        (tag, pattern)
        for tag, pattern in _Loader.yaml_implicit_resolvers[_letter]
        if tag != "tag:yaml.org,2002:bool"
    ]


def read_yaml(path: Path | str) -> Tree:
    """A YAML file that holds a mapping.

    Raises:
        InputError: no such file, not YAML (with the line), or not a mapping.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    return _parse_yaml(text, str(path), mapping=True)


def _parse_yaml(text: str, source: str, mapping: bool = False) -> object:
    try:
        value = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" line {mark.line + 1}:" if mark else ""
        reason = " ".join(str(getattr(error, "problem", error)).split())
        raise InputError(f"{source}:{where} {reason}") from error
    if mapping and value is None:
        return {}
    if mapping and not isinstance(value, dict):
        raise InputError(f"{source}: expected a mapping of keys to values")
    return value


def read_yaml_with_base(path: Path | str, _seen: tuple[Path, ...] = ()) -> Tree:
    """A YAML mapping laid over the file that it names as ``base``, if it names one."""
    path = Path(path)
    if path.resolve() in _seen:
        raise InputError(f"{path}: 'base' leads back to itself")
    tree = read_yaml(path)
    base = tree.pop("base", None)
    if base is None:
        return tree
    if not isinstance(base, str):
        raise InputError(f"{path}: base is {base!r}, expected the name of a config file")
    under = read_yaml_with_base(path.parent / base, (*_seen, path.resolve()))
    return merge_trees(under, tree)


def parse_words(words: Sequence[str]) -> Tree:
    """Dotted ``key=value`` words as a tree; values are read as YAML.

    Raises:
        InputError: a word that is not ``key=value``.
    """
    tree: Tree = {}
    for word in words:
        key, equals, text = word.partition("=")
        parts = key.split(".")
        if not equals or not all(parts):
            raise InputError(f"{word!r} is not of the form key=value")
        value = _parse_yaml(text, key)
        for part in reversed(parts):
            value = {part: value}
        tree = merge_trees(tree, value)
    return tree


def merge_trees(under: Tree, over: Tree) -> Tree:
    """``over`` laid over ``under``: mappings merge, all else is replaced."""
    merged = dict(under)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = merge_trees(merged[key], value)
        else:
            merged[key] = value
    return merged


def find_file(name: str, folder: str, beside: Path) -> Path:
    """A file named in a config: beside the config, in its ``folder``, or the project's own."""
    places = [Path(name), beside / name, beside / folder / name, CONFIGS / folder / name]
    for place in places:
        if place.is_file():
            return place
    raise InputError(f"{name}: no such file in {folder}/ (looked at {places[-1]} too)")


def _with_file(
    tree: Tree, section: str, values: typing.Callable[[Tree, Path], Tree], beside: Path
) -> Tree:
    """Lay a section of the config over the file that it names."""
    own = tree.get(section, {})
    if not isinstance(own, dict):
        raise InputError(f"{section}: {own!r} is not a mapping")
    name = own.get("file") or getattr(Config(), section).file
    if not isinstance(name, str):
        raise InputError(f"{section}.file is {name!r}, expected the name of a file")
    path = find_file(name, f"{section}s", beside)
    if path != CONFIGS / f"{section}s" / name:
        own = {**own, "file": str(path.resolve())}  # found again from wherever this is saved
    return {**tree, section: merge_trees(values(read_yaml(path), path), own)}


def _vehicle_values(tree: Tree, path: Path) -> Tree:
    allowed = {"name", "mass", "motor", "rate"}
    for key in tree:
        if key not in allowed:
            raise InputError(f"{path}: unknown key {key}; allowed: {', '.join(sorted(allowed))}")
    return {key: tree[key] for key in allowed if key in tree}


def _track_values(tree: Tree, path: Path) -> Tree:
    for key in tree:
        if key not in ("name", "gates"):
            raise InputError(f"{path}: unknown key {key}; allowed: gates, name")
    return tree


def to_yaml(config: Config) -> str:
    """The full config as YAML, which ``load_config`` reads back."""
    return OmegaConf.to_yaml(OmegaConf.structured(config))
