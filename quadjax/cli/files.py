"""Files on the command line: how they differ from overrides, and checks of output paths."""

import dataclasses
import inspect
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, get_type_hints

from quadjax.core.errors import InputError, prefixed, writing
from quadjax.core.files import check_file


@dataclasses.dataclass(frozen=True)
class Output:
    """Marks an option that names a file to write; it is checked before any work is done.

    Attributes:
        suffixes: the allowed ones; any if empty.
    """

    suffixes: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class OutputFolder:
    """Marks an option that names a folder to write to; its default value is checked, too."""


def option_name(name: str) -> str:
    """The option that sets an argument of a command: ``--plant-seed`` for ``plant_seed``."""
    return f"--{name.strip('_').replace('_', '-')}"


def is_override(text: str) -> bool:
    """Whether an argument is ``key=value`` or ``+part``, not a file, whose path may have ``=``."""
    key, equals, _ = text.partition("=")
    is_change = bool(equals) and not set("/ ") & set(key)
    return text.startswith("+") or (is_change and not os.path.exists(text))


def check_outputs(command: Callable[..., Any], arguments: Mapping[str, Any]) -> None:
    """Check output files and folders before any work is done.

    Args:
        command: function whose annotations ``Output`` and ``OutputFolder`` mark the outputs.
        arguments: the arguments of the command line, by name.

    Raises:
        InputError: an output that ``check_writable`` or ``writable_folder`` rejects, or that is the
            file of another argument.
    """
    files = list(_files(arguments))
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        value = arguments.get(name, parameter.default)
        for mark in getattr(hints.get(name), "__metadata__", ()):
            if isinstance(mark, OutputFolder):
                with prefixed(option_name(name)):
                    writable_folder(str(value))
            if isinstance(mark, Output) and value is not None:
                check_writable(Path(value), mark.suffixes)
                real = os.path.realpath(value)
                others = [other for other, file in files if file == real and other != name]
                if others:
                    raise InputError(
                        f"{option_name(name)} {value}: is also the file of the argument "
                        f"{others[0]}, allowed: another file"
                    )


def _files(arguments: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Name and real path of each argument, or value of an override, that may be a file."""
    files = []
    for name, values in arguments.items():
        for value in values if isinstance(values, (list, tuple)) else [values]:
            if not isinstance(value, (str, Path)) or "\0" in str(value):
                continue
            files.append((name, os.path.realpath(value)))
            key, _, text = str(value).partition("=")
            if is_override(str(value)) and key.split(".")[-1] != "name":
                files.append((name, os.path.realpath(text)))
    return files


def check_writable(path: Path, suffixes: Sequence[str] = (), overwrite: bool = True) -> None:
    """Check the path of an output file before any work is done.

    Args:
        path: of a file to write.
        suffixes: the allowed ones; any if empty.
        overwrite: whether an existing file may be replaced.

    Raises:
        InputError: a wrong suffix, a directory, a link, a pipe, a device, or a folder that does
            not exist or cannot be written.
    """
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: suffix is {path.suffix!r}, allowed: {', '.join(suffixes)}")
    with writing(path):
        if path.is_symlink():
            raise InputError(f"{path}: is a link, expected the name of a file")
        if path.exists():
            check_file(path)
        if not path.parent.is_dir():
            raise InputError(f"{path}: the folder {path.parent} does not exist")
        if not os.access(path.parent, os.W_OK):
            raise InputError(f"{path}: cannot be written (no permission in {path.parent})")
    if path.exists() and not overwrite:
        raise InputError(f"{path}: already exists, allowed: another name, or --overwrite")


def writable_folder(text: str) -> Path:
    """The path of a folder, after a check that it, or its nearest existing parent, is writable.

    Raises:
        ValueError: the path of a file, or no permission to write.
    """
    folder = Path(text)
    nearest = next(path for path in (folder, *folder.parents) if path.exists())
    if nearest.is_file():
        raise ValueError(f"{nearest} is a file, allowed: a folder")
    if not os.access(nearest, os.W_OK):
        raise ValueError(f"{text}: no permission in {nearest}, allowed: a folder to write to")
    return folder
