"""What commands print and write: their present step, the names of files, and results as JSON."""

import contextvars
import os
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

SECONDS = 5.0  # between lines where there is no terminal
ARGUMENTS: contextvars.ContextVar[Sequence[str]] = contextvars.ContextVar("ARGUMENTS", default=())


def stderr() -> Console:
    """Where messages go. A notebook's command line has a pseudo-terminal that shows every line."""
    return Console(stderr=True, force_terminal=False if "JPY_PARENT_PID" in os.environ else None)


@contextmanager
def steps(console: Console | None = None) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the present step of a command until the block ends.

    A terminal has one line that changes. Elsewhere it prints lines, at most one in ``SECONDS``.

    Args:
        console: that of stderr if not given.
    """
    console = console or stderr()
    if console.is_terminal:
        with console.status("starting") as status:
            yield status.update
        return
    printed = -SECONDS

    def report(text: str) -> None:
        nonlocal printed
        if time.monotonic() - printed >= SECONDS:
            printed = time.monotonic()
            console.print(text, highlight=False, markup=False, soft_wrap=True)

    yield report


def note(text: str) -> None:
    """Print a line to stderr, apart from the results of a command."""
    stderr().print(text, highlight=False, markup=False, soft_wrap=True)


def wrote(*paths: Path | str | None) -> None:
    """Say which files a command has written; None is an output that was not asked for."""
    for path in paths:
        if path is not None:
            note(f"wrote {path}")


def command_again(without: str = "--overwrite", more: str | None = None) -> str:
    """The command line that was given, without an option and with another one."""
    words = [word for word in ARGUMENTS.get() if word not in (without, more)]
    return shlex.join(["quadjax", *words, *([more] if more else [])])
