"""The layers of a YAML file: its bases, their merge, and which file each value comes from."""

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from quadjax.core.errors import InputError, prefixed, short
from quadjax.core.resources import CONFIGS, find_file
from quadjax.core.yaml_files import MAX_DEPTH, Tree, flatten, merge_trees, read_yaml

Layer = tuple[Path | str, Tree]  # a file, or "overrides", and the values that it sets


def read_layers(path: Path | str, kind: str = "", chain: tuple[Path, ...] = ()) -> list[Layer]:
    """A YAML mapping and those of the files that its key ``base`` names, the lowest first.

    A base is a path relative to the file that names it, or the name of a file in ``configs/`` or
    ``configs/kind``, with or without ``.yaml``. ``base`` is one or a list; each is merged over
    those before it.

    Args:
        path: the file.
        kind: folder of ``configs/`` with files of its kind.
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
    layers: list[Layer] = []
    for name in names:
        with prefixed(f"{path}: base"):
            base = find_file(name, [path.parent, CONFIGS], kind)
        if base.resolve() in chain:
            raise InputError(f"{path}: base {name} leads back to itself")
        layers += read_layers(base, kind, chain)
    return [*layers, (path, tree)]


def read_tree_with_bases(path: Path | str, kind: str = "") -> Tree:
    """A YAML mapping merged over its bases; see ``read_layers``."""
    return merge_layers(read_layers(path, kind), path)[0]


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


def merge_layers(
    layers: Sequence[Layer],
    path: Path | str,
    drop_replaced: Callable[[Tree, Tree, str], Tree] = lambda tree, over, source: tree,
) -> tuple[Tree, Sources]:
    """Trees merged in their order, and the source of each value.

    Args:
        layers: source and tree of each.
        path: of the config.
        drop_replaced: ``(tree, over, source) -> tree`` without the values that ``over``
            replaces.
    """
    tree: Tree = {}
    files: dict[str, str] = {}
    for source, over in layers:
        tree = merge_trees(drop_replaced(tree, over, str(source)), over)
        keys = flatten(over)
        replaced = tuple(f"{key}." for key in keys)
        files = {name: file for name, file in files.items() if not name.startswith(replaced)}
        for key in keys:
            while key:
                files[key] = str(source)
                key = key.rpartition(".")[0]
    return tree, Sources(str(path), files)
