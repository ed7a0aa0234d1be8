"""Which file a value of a merged config comes from, for messages."""

import contextlib
import re
from collections.abc import Iterator
from typing import NamedTuple

from quadjax.core.errors import InputError
from quadjax.core.yaml_files import Tree

DOTTED = re.compile(r"[A-Za-z_]\w*(?:\.\w+|\[\d+\])+")  # learner.std, track.gates[0].size
TOP = re.compile(r"(?:unknown key )?([A-Za-z_]\w*)")  # seed, at the start of a message


class Layer(NamedTuple):
    """A file, or the overrides of a command line, and what it sets."""

    source: str
    tree: Tree


def layer_of(section: str, values: Tree) -> Tree:
    """What a track or vehicle file sets, by the keys of a config.

    Args:
        section: ``track`` or ``vehicle``.
        values: of the section; constants are in ``models``, by model.
    """
    rest = {key: value for key, value in values.items() if key != "rules"}
    models = values.get("models")
    if isinstance(models, dict):
        parts = [part for part in models.values() if isinstance(part, dict)]
        rest["constants"] = {key: value for part in parts for key, value in part.items()}
    return {section: rest, "rules": values.get("rules", {})}


@contextlib.contextmanager
def from_layers(layers: list[Layer], path: str) -> Iterator[None]:
    """Change the path of an ``InputError`` in the block to that of the last file with its key.

    Args:
        layers: in the order in which they were merged.
        path: of the config.
    """
    try:
        yield
    except InputError as error:
        text = str(error)
        if not text.startswith(f"{path}: "):
            raise
        source = _source(layers, text.removeprefix(f"{path}: ")) or path
        raise InputError(source + text.removeprefix(path)) from error


def _source(layers: list[Layer], text: str) -> str | None:
    """The last layer that sets the first key in a text, or the section of a dotted one."""
    dotted, top = DOTTED.search(text.partition(", allowed")[0]), TOP.match(text)
    if dotted is None:
        key = top[1] if top else ""
        return next((layer.source for layer in reversed(layers) if key in layer.tree), None)
    parts = re.findall(r"\w+", dotted[0])
    for count in range(len(parts), 1, -1):
        for layer in reversed(layers):
            for root in (layer.tree, layer.tree.get("schedules")):
                if _has(root, parts[:count]):
                    return layer.source
    return None


def _has(node: object, parts: list[str]) -> bool:
    """Whether a tree has a key, whose parts may be joined by dots in it."""
    if not parts:
        return True
    if isinstance(node, (list, tuple)):
        return parts[0].isdigit() and int(parts[0]) < len(node)
    if not isinstance(node, dict):
        return False
    ends = range(len(parts), 0, -1)
    return any(
        ".".join(parts[:end]) in node and _has(node[".".join(parts[:end])], parts[end:])
        for end in ends
    )
