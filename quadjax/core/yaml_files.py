"""YAML 1.2 files, ``key=value`` overrides and their composition, as plain dictionaries."""

import contextlib
import functools
import io
import itertools
import json
import re
import shlex
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.nodes import ScalarNode
from ruamel.yaml.representer import RoundTripRepresenter

from quadjax.core.errors import InputError, short
from quadjax.core.files import read_text
from quadjax.core.resources import refuse_part

WIDTH = 79  # of comments, characters
MAX_VALUES = 10**6  # of a file, which may come from a stranger
MAX_DEPTH = 20  # of dotted keys, and of files that name a base
Tree = dict[str, Any]


def read_yaml(path: Path | str) -> Tree:
    """The mapping that a YAML 1.2 file holds.

    Raises:
        InputError: not a regular file, unreadable, not YAML (with the line), a repeated key,
            nested too deep, or not a mapping.
    """
    tree = parse_yaml(read_text(path), str(path))
    if tree is None:
        return {}
    if not isinstance(tree, dict):
        raise InputError(f"{path}: expected a mapping of keys to values")
    return tree


def parse_yaml(text: str, source: str) -> object:
    """The value of a YAML 1.2 text: None, bool, int, float, str, list or dict with str keys.

    Raises:
        InputError: it starts with ``source`` and, where it is known, the line.
    """
    where, reason = "", "nested too deep"
    try:
        return json.loads(_as_json(text))
    except RecursionError:
        pass
    except MarkedYAMLError as error:
        where = f" line {error.problem_mark.line + 1}:" if error.problem_mark else ""
        reason = str(error.problem).partition(" with value")[0]  # of a key that is there twice
    except (YAMLError, ValueError, TypeError) as error:
        reason = f"not YAML of plain values ({error})"
    raise InputError(f"{source}:{where} {short(' '.join(reason.split()), 160, str)}")


@functools.lru_cache(maxsize=256)
def _as_json(text: str) -> str:
    """The value of a YAML text as JSON; only plain values pass. Equal texts are parsed once."""
    value = _loader().load(text)
    if sum(1 for _ in itertools.islice(_values(value), MAX_VALUES + 1)) > MAX_VALUES:
        raise ValueError(f"more than {MAX_VALUES:,} values, with those of aliases")
    return json.dumps(value)


def _values(value: object) -> Iterator[object]:
    """A value and every value in it; one with several aliases counts at each."""
    yield value
    if isinstance(value, dict | list):
        for item in value.values() if isinstance(value, dict) else value:
            yield from _values(item)


def _loader() -> YAML:
    loader = YAML(typ="safe", pure=True)
    resolvers = loader.resolver.versioned_resolver
    for first, entries in resolvers.items():  # a date such as 2026-01-31 is plain text
        resolvers[first] = [entry for entry in entries if "timestamp" not in entry[0]]
    return loader


class Whole(Tree):
    """A mapping that replaces the one below it in a merge."""


def merge_trees(under: Tree, over: Tree) -> Tree:
    """``over`` on top of ``under``: mappings merge, every other value is replaced."""
    merged = dict(under)
    for key, value in over.items():
        lower = merged.get(key)
        if isinstance(value, dict) and isinstance(lower, dict) and not isinstance(value, Whole):
            value = merge_trees(lower, value)
        merged[key] = value
    return merged


def flatten(tree: Mapping[str, object], leaf: Sequence[str] = ()) -> Tree:
    """The values of nested mappings by dotted key; lists and empty mappings are values.

    Args:
        tree: the mapping.
        leaf: a mapping with any of these keys is a value too.
    """
    flat: Tree = {}
    for key, value in tree.items():
        if isinstance(value, Mapping) and value and not any(name in value for name in leaf):
            flat |= {f"{key}.{name}": item for name, item in flatten(value, leaf).items()}
        else:
            flat[key] = value
    return flat


def parse_overrides(overrides: Sequence[str]) -> Tree:
    """``key=value`` overrides with dotted keys, as a tree; see ``_override_value``.

    Raises:
        InputError: an override that is not ``key=value``, or a list or mapping that is not YAML.
    """
    tree: Tree = {}
    for override in overrides:
        refuse_part(override)
        key, equals, text = override.partition("=")
        parts = key.split(".")
        if not equals or not all(parts) or len(parts) > MAX_DEPTH:
            raise InputError(f"{short(override)} is not of the form key=value")
        if not text.strip():
            raise InputError(f"{key}= has no value, allowed: a value after the =, null for none")
        value = _override_value(key, text.strip())
        for part in reversed(parts):
            value = {part: value}
        tree = merge_trees(tree, value)
    return tree


def _override_value(key: str, text: str) -> Any:
    """The value of an override: YAML that begins with a quote, ``[`` or ``{``, or one scalar.

    A scalar is a number, ``true``, ``false``, ``null`` or the text as it is, also with characters
    that YAML gives a meaning, such as those of a file's name: there are no comments, for example.
    """
    if text[0] in "\"'[{":
        try:
            values = parse_yaml(f"[{text}]", key)  # a comment in the text is an error here
            if isinstance(values, list) and len(values) == 1:
                return values[0]
            reason = f"{key}: several values"
        except InputError as error:
            reason = str(error)
        raise InputError(f"{reason}; as a text with quotes: {shlex.quote(override(key, text))}")
    if text[0] not in "#&!" and len(text.split()) == 1:
        with contextlib.suppress(InputError):
            value = parse_yaml(text, key)
            if not isinstance(value, str | list | dict):
                return value
    return text


def override(key: str, value: object) -> str:
    """A ``key=value`` override, which ``parse_overrides`` reads back."""
    return f"{key}={json.dumps(value)}"


def to_yaml(tree: Mapping[str, object], comments: Mapping[str, str] | None = None) -> str:
    """A tree as YAML: nested mappings in block style, lists and what is in them in flow style.

    Args:
        tree: plain values; ``section.model_dump()`` of a section.
        comments: text for the lines above a key, by dotted key.
    """
    writer = YAML()
    writer.Representer = _Representer
    writer.width = 10**6
    writer.indent(mapping=2, sequence=4, offset=2)
    stream = io.StringIO()
    if tree:
        writer.dump(_block(tree, "", comments or {}), stream)
    return stream.getvalue()


class _Representer(RoundTripRepresenter):
    """Writes ``null`` for None, and ``1.0e-05``: YAML 1.1 reads ``1e-05`` as text."""


_Representer.add_representer(
    type(None), lambda writer, _: writer.represent_scalar("tag:yaml.org,2002:null", "null")
)


def _represent_float(writer: RoundTripRepresenter, number: float) -> ScalarNode:
    node = writer.represent_float(number)
    node.value = re.sub(r"^(-?\d+)e", r"\1.0e", node.value)
    return node


_Representer.add_representer(float, _represent_float)


def _block(tree: Mapping[str, object], prefix: str, comments: Mapping[str, str]) -> CommentedMap:
    block, depth = CommentedMap(), prefix.count(".")
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            block[key] = _block(value, f"{prefix}{key}.", comments)
        elif isinstance(value, (list, tuple)) and any(isinstance(v, Mapping) for v in value):
            block[key] = CommentedSeq(map(_flow, value))
        else:
            block[key] = _flow(value)
        if text := comments.get(f"{prefix}{key}"):
            lines = textwrap.fill(text, WIDTH - 2 * depth - 2, break_long_words=False)
            block.yaml_set_comment_before_after_key(key, before=lines, indent=2 * depth)
    return block


def _flow(value: object) -> object:
    """A value in flow style: on one line."""
    if not isinstance(value, (Mapping, list, tuple)):
        return value
    node = CommentedMap(value) if isinstance(value, Mapping) else CommentedSeq(value)
    node.fa.set_flow_style()
    return node
