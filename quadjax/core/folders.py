"""Folders of results: each has a kind, a lock while a process writes to it, and files by pattern.

The kind (training, fit, sweep, export, comparison, report, replay, flight, logs) is in the file
``.quadjax.json``. A program writes only to a folder of the same kind, and removes only the files
that it writes itself. In a folder without a kind it replaces files of the same names only with
``--overwrite``. A command that is rejected removes the folders that it created. ``.lock`` is locked
while a process writes to the folder.
"""

import contextlib
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from filelock import FileLock, Timeout

from quadjax.core.errors import InputError, writing
from quadjax.core.files import check_file, read_json, write_json
from quadjax.core.interruptions import uninterrupted

MARKER = ".quadjax.json"
LOCK = ".lock"
NEW = ".new-"  # prefix of folders of results that are not complete
NOUNS = {"training": "a run", "logs": "logs"}  # of kinds, where not the kind with an article
NO_RESULTS = {MARKER, LOCK, "config.yaml", "inputs"}  # in the folder of a failed command


@contextlib.contextmanager
def claim(
    folder: Path | str, kind: str, files: Iterable[str] = (), overwrite: bool = False
) -> Iterator[None]:
    """Create a folder, or take one of the same kind, and lock it for the duration of the block.

    The operating system releases the lock when the process ends. If the block fails in a new
    folder before it has results, the folder is removed.

    Args:
        folder: created if needed.
        kind: of the program: ``training``, ``fit``, ..
        files: patterns of the files that the block writes; see ``check_kind``.
        overwrite: accept such files in a folder without a kind.

    Raises:
        InputError: as ``check_kind``; a folder that cannot be written, or is locked.
    """
    folder = Path(folder)
    check_kind(folder, kind, () if overwrite else files)
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    lock = FileLock(folder / LOCK, timeout=0)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            lock.acquire()
        except Timeout:
            raise InputError(
                f"{folder} is in use by another process: choose another name"
            ) from None
    try:
        if kind_of(folder) is None:
            write_json(folder / MARKER, {"kind": kind})
        yield
    except BaseException:
        if new and {path.name for path in folder.iterdir()} <= NO_RESULTS:
            shutil.rmtree(folder, ignore_errors=True)
            with contextlib.suppress(OSError):
                for path in new[1:]:
                    path.rmdir()
        raise
    finally:
        lock.release()


def check_kind(folder: Path | str, kind: str, files: Iterable[str] = ()) -> None:
    """Refuse a folder of another kind, and one without a kind that has files of these patterns.

    Raises:
        InputError: with the kind, or the names of the files.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected a folder")
    present = kind_of(folder)
    if present is not None and present != kind:
        raise InputError(f"{folder} holds {_noun(present)}, not {_noun(kind)}: choose another name")
    names = [path.name for pattern in files for path in sorted(folder.glob(pattern))]
    if present is None and names:
        raise InputError(
            f"{folder} holds no {kind}, but {', '.join(names[:3])}{', ..' * bool(names[3:])}: "
            "choose another folder, or replace these files (--overwrite)"
        )


def _noun(kind: str) -> str:
    return NOUNS.get(kind, f"a{'n' * (kind[:1] in 'aeiou')} {kind}")


def kind_of(folder: Path | str) -> str | None:
    """The kind of a folder; None if it has none.

    Raises:
        InputError: a damaged marker.
    """
    marker = Path(folder) / MARKER
    if not marker.exists():
        return None
    kind = read_json(marker).get("kind")
    if not isinstance(kind, str):
        raise InputError(f"{marker}: kind is {kind!r}, expected a name")
    return kind


def remove_files(folder: Path | str, patterns: Iterable[str]) -> None:
    """Remove the files and subfolders that match a pattern; everything else stays."""
    for path in [path for pattern in patterns for path in Path(folder).glob(pattern)]:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def results(
    folder: Path | str, kind: str, files: Sequence[str], overwrite: bool = False
) -> Iterator[Path]:
    """Claim a folder, and yield a temporary one, whose files replace earlier results at the end.

    The arguments are those of ``claim``; ``overwrite`` replaces earlier results, too.

    Raises:
        InputError: also where there are earlier results, before the block.
    """
    with claim(folder, kind, files, overwrite):
        if not overwrite and any(any(Path(folder).glob(pattern)) for pattern in files):
            either = "replace them (--overwrite) or choose another name"
            raise InputError(f"{folder} already holds the results of {_noun(kind)}: {either}")
        with replacement(folder, files) as new:
            yield new


@contextlib.contextmanager
def replacement(folder: Path | str, patterns: Iterable[str]) -> Iterator[Path]:
    """A temporary folder, whose files replace those of a locked folder if the block succeeds.

    Args:
        folder: of the results.
        patterns: of files that are removed from it first; see ``remove_files``.

    Raises:
        InputError: a directory, a pipe or a device in the place of a file.
    """
    folder = Path(folder)
    remove_files(folder, [f"{NEW}*"])  # of a killed process
    with writing(folder):
        temporary = Path(tempfile.mkdtemp(dir=folder, prefix=NEW))
    try:
        yield temporary
        files = [path.relative_to(temporary) for path in temporary.rglob("*") if path.is_file()]
        with writing(folder):
            for file in files:
                if (folder / file).exists():
                    check_file(folder / file)
            with uninterrupted():
                remove_files(folder, patterns)
                for file in files:
                    (folder / file).parent.mkdir(parents=True, exist_ok=True)
                    (temporary / file).replace(folder / file)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
