"""YAML 1.2 files, ``key=value`` overrides and their composition, as plain dictionaries."""

import dataclasses
import difflib
import io
import json
import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.representer import RoundTripRepresenter

from quadjax.core.errors import InputError, prefixed, reading
from quadjax.core.files import read_text
from quadjax.core.resources import CONFIGS, preset_names

WIDTH = 79  # of comments, characters
Tree = dict[str, Any]

MAX_BYTES = 2**20  # of one file
MAX_VALUES = 100_000  # of one file, aliases counted each time they are used
MAX_DEPTH = 20  # of nested values, and of files that name a base


def read_yaml(path: Path | str) -> Tree:
    """The mapping that a YAML 1.2 file holds.

    Raises:
        InputError: not a regular file, unreadable, over 1 MiB, not YAML (with the line), a
            repeated key, nested too deep, or not a mapping.
    """
    tree = parse_yaml(read_text(path, MAX_BYTES), str(path))
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
    try:
        value = _loader().load(text)
    except MarkedYAMLError as error:
        where = f" line {error.problem_mark.line + 1}:" if error.problem_mark else ""
        reason = " ".join(str(error.problem).split())
        raise InputError(f"{source}:{where} {_short(reason, 120)}") from error
    except RecursionError:
        raise InputError(f"{source}: nested deeper than {MAX_DEPTH} levels") from None
    except (YAMLError, ValueError) as error:
        raise InputError(
            f"{source}: not YAML ({_short(' '.join(str(error).split()), 120)})"
        ) from error
    _check_plain(value, source, 0, [0])
    return value


def _loader() -> YAML:
    loader = YAML(typ="safe", pure=True)
    resolvers = loader.resolver.versioned_resolver
    for first, entries in resolvers.items():  # a date such as 2026-01-31 is plain text
        resolvers[first] = [entry for entry in entries if "timestamp" not in entry[0]]
    return loader


def _check_plain(value: object, source: str, depth: int, count: list[int]) -> None:
    count[0] += 1
    if depth > MAX_DEPTH or count[0] > MAX_VALUES:
        limit = f"{MAX_DEPTH} levels" if depth > MAX_DEPTH else f"{MAX_VALUES} values"
        raise InputError(f"{source}: more than {limit}")
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise InputError(f"{source}: the key {short(key)} is not text")
            _check_plain(item, source, depth + 1, count)
    elif isinstance(value, list):
        for item in value:
            _check_plain(item, source, depth + 1, count)
    elif not (value is None or isinstance(value, (bool, int, float, str))):
        raise InputError(f"{source}: {short(value)} is not a plain value")


def read_layers(path: Path | str, chain: tuple[Path, ...] = ()) -> list[tuple[Path, Tree]]:
    """A YAML mapping and those of the files that its key ``base`` names, the lowest first.

    A base is a path relative to the file that names it, or the name of a file in ``configs/``,
    with or without ``.yaml``. ``base`` is one or a list; each is merged over those before it.

    Args:
        path: the file.
        chain: files whose bases lead to this one.

    Raises:
        InputError: a file that cannot be read, a base that leads back to itself, a long chain.
    """
    path = Path(path)
    tree = read_yaml(path)
    bases = tree.pop("base", [])
    names = [bases] if isinstance(bases, str) else bases
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise InputError(f"{path}: base is {short(bases)}, allowed: a file name or a list of them")
    chain = (*chain, path.resolve())
    if len(chain) > MAX_DEPTH:
        raise InputError(f"{path}: a chain of more than {MAX_DEPTH} bases")
    layers: list[tuple[Path, Tree]] = []
    for name in names:
        with prefixed(f"{path}: base"):
            base = find_file(name, path.parent)
        if base.resolve() in chain:
            raise InputError(f"{path}: base {name} leads back to itself")
        layers += read_layers(base, chain)
    return [*layers, (path, tree)]


def read_tree_with_bases(path: Path | str) -> Tree:
    """A YAML mapping merged over its bases; see ``read_layers``."""
    return merge_layers([(str(file), tree) for file, tree in read_layers(path)], str(path))[0]


@dataclasses.dataclass(frozen=True)
class Sources:
    """Which file each value of a merged tree comes from.

    Attributes:
        path: of the config.
        files: by the dotted key of each value, and of each section: the last file with a value in
            it.
    """

    path: str
    files: dict[str, str]

    def of(self, key: str) -> str:
        """The file of a dotted key, or of the section around it."""
        key = re.sub(r"\[\d+\]", "", key)
        while key and key not in self.files:
            key = key.rpartition(".")[0]
        return self.files.get(key, self.path)


def merge_layers(layers: Sequence[tuple[str, Tree]], path: str) -> tuple[Tree, Sources]:
    """Trees merged in their order, and the source of each value.

    Args:
        layers: source and tree of each.
        path: of the config.
    """
    tree: Tree = {}
    files: dict[str, str] = {}
    for source, over in layers:
        tree = merge_trees(tree, over)
        files |= files_of(over, source)
    return tree, Sources(path, files)


def files_of(tree: Tree, file: str) -> dict[str, str]:
    """A file, by the dotted key of each of its values and sections."""
    files: dict[str, str] = {}
    for key in flatten(tree):
        while key:
            files[key] = file
            key = key.rpartition(".")[0]
    return files


def find_file(name: str, folder: Path, kind: str = ".") -> Path:
    """A file named in a config: in ``folder``, in its subfolder ``kind``, or in ``configs/kind``.

    The suffix ``.yaml`` may be left out.

    Raises:
        InputError: no such file.
    """
    names = [name] if Path(name).suffix == ".yaml" else [name, f"{name}.yaml"]
    places = [folder, folder / kind, CONFIGS / kind]
    with reading(short(name)):
        for place in places:
            for file in names:
                if (place / file).exists() and not (place / file).is_dir():
                    return place / file
    stems = [path.stem for place in places for path in sorted(place.glob("*.yaml"))]
    hint = close_match(Path(name).stem, stems)
    shipped = f"; {kind} of quadjax: {', '.join(preset_names(kind))}" if kind != "." else ""
    raise InputError(f"{short(name)}: no such file in {folder} or {CONFIGS / kind}{hint}{shipped}")


def merge_trees(under: Tree, over: Tree) -> Tree:
    """``over`` on top of ``under``: mappings merge, every other value is replaced."""
    merged = dict(under)
    for key, value in over.items():
        below = merged.get(key)
        if isinstance(value, dict) and isinstance(below, dict):
            value = merge_trees(below, value)
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
    """``key=value`` overrides with dotted keys, as a tree; each value is read as YAML.

    Raises:
        InputError: an override that is not ``key=value``.
    """
    tree: Tree = {}
    for override in overrides:
        key, equals, text = override.partition("=")
        parts = key.split(".")
        if not equals or not all(parts) or len(parts) > MAX_DEPTH:
            raise InputError(f"{short(override)} is not of the form key=value")
        value: Any = parse_yaml(text, key)
        for part in reversed(parts):
            value = {part: value}
        tree = merge_trees(tree, value)
    return tree


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
    """Writes ``null`` for None."""


_Representer.add_representer(
    type(None), lambda writer, _: writer.represent_scalar("tag:yaml.org,2002:null", "null")
)


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
    node: CommentedMap | CommentedSeq
    if isinstance(value, Mapping):
        node = CommentedMap((key, _flow(item)) for key, item in value.items())
    elif isinstance(value, (list, tuple)):
        node = CommentedSeq(_flow(item) for item in value)
    else:
        return value
    node.fa.set_flow_style()
    return node


def short(value: object) -> str:
    """``repr`` of a value, at most 60 characters, also of a number with thousands of digits."""
    try:
        return _short(repr(list(value) if isinstance(value, tuple) else value), 60)
    except ValueError:
        return "a number of thousands of digits"


def _short(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 3]}..."


def close_match(name: str, allowed: Sequence[str]) -> str:
    """``"; did you mean X?"`` for the allowed name closest to ``name``, or nothing."""
    found = difflib.get_close_matches(name, allowed, n=1)
    return f"; did you mean {found[0]}?" if found else ""
