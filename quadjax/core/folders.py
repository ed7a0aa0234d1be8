"""Folders of results: each has a kind, a lock while a process writes to it, and known files.

A folder's kind (training, fit, sweep, export) is in its file ``.quadjax.json``. A program writes
only to a folder of its own kind, and removes only the files that it writes itself.
"""

import contextlib
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from quadjax.core.errors import InputError
from quadjax.core.files import read_json, remove_stale, write_json

MARKER = ".quadjax.json"
LOCK = ".lock"
EVIDENCE = {  # of folders without a marker, which earlier versions wrote
    "training": "checkpoints",
    "sweep": "study.journal",
    "fit": "vehicle.yaml",
}


@contextlib.contextmanager
def claim(folder: Path | str, kind: str) -> Iterator[None]:
    """Create a folder, or take one of the same kind, and lock it for the duration of the block.

    The operating system releases the lock when the process ends. Temporary files
    that a killed process left are removed.

    Args:
        folder: created if needed.
        kind: training, fit, sweep or export.

    Raises:
        InputError: the folder is of another kind, cannot be written, or is locked.
    """
    folder = Path(folder)
    check_kind(folder, kind)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = FileLock(folder / LOCK, timeout=0)
        with lock:
            remove_stale(folder)
            if not (folder / MARKER).exists():
                write_json(folder / MARKER, {"kind": kind})
            yield
    except Timeout:
        raise InputError(f"{folder} is in use by another process: choose another name") from None


def kind_of(folder: Path | str) -> str | None:
    """The kind of a folder; None if it has none.

    Raises:
        InputError: a damaged marker.
    """
    folder = Path(folder)
    marker = folder / MARKER
    if marker.exists():
        kind = read_json(marker).get("kind")
        if not isinstance(kind, str):
            raise InputError(f"{marker}: kind is {kind!r}, expected a name")
        return kind
    found = (kind for kind, name in EVIDENCE.items() if (folder / name).exists())
    return next(found, None)


def check_kind(folder: Path | str, kind: str) -> None:
    """Raise an ``InputError`` for a folder that belongs to a program of another kind."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected a folder")
    found = kind_of(folder)
    if found not in (None, kind):
        raise InputError(f"{folder} holds a {found}, not a {kind}: choose another name")


def remove_files(folder: Path | str, names: Iterable[str]) -> None:
    """Remove the named files and subfolders of a folder; everything else stays."""
    for name in names:
        path = Path(folder) / name
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)
