"""What the scripts' command lines share."""

import argparse
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NoReturn

from quadjax.core.errors import InputError


class Parser(argparse.ArgumentParser):
    """An argument parser whose every complaint is one line, an ``InputError``."""

    def error(self, message: str) -> NoReturn:
        """Raise what went wrong."""
        raise InputError(f"{message} (try --help)")


def parse(
    parser: argparse.ArgumentParser, arguments: Sequence[str] | None = None
) -> argparse.Namespace:
    """Parse options and positional words in any order.

    Raises:
        InputError: what the parser complains about.
    """
    try:
        return parser.parse_intermixed_args(arguments)
    except argparse.ArgumentError as error:
        raise InputError(f"{error} (try --help)") from error


def count(text: str) -> int:
    """A whole number from 1, for ``type=``."""
    number = int(text) if text.lstrip("+-").isdigit() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number from 1")
    return number


def count_up_to(most: int) -> Callable[[str], int]:
    """A ``type=`` for whole numbers from 1 to ``most``."""

    def bounded(text: str) -> int:
        number = count(text)
        if number > most:
            raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number, 1 to {most}")
        return number

    return bounded


def seed(text: str) -> int:
    """A whole number from 0 to 2^31 - 1, for ``type=``."""
    if not text.isdigit() or int(text) >= 2**31:
        raise argparse.ArgumentTypeError(f"{text!r}, expected a whole number, 0 to {2**31 - 1}")
    return int(text)


def check_writable(path: Path | str | None, suffixes: Sequence[str] = ()) -> None:
    """Refuse an output path before any work is done; None is fine.

    Args:
        path: of a file to write; its folder is made.
        suffixes: allowed ones, if they matter.

    Raises:
        InputError: a wrong suffix, a directory, or a place where nothing can be written.
    """
    if path is None:
        return
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: suffix is {path.suffix!r}, allowed: {', '.join(suffixes)}")
    if path.is_dir():
        raise InputError(f"{path}: is a directory, expected the name of a file")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent):
            pass
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from error
