"""What commands print and write: their present step, the names of files, and results as JSON."""

import contextvars
import os
import re
import shlex
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console

LINE_AFTER_S = 5.0  # after which a step prints a line where there is no terminal
DURATION = re.compile(r": [\d.]+ s\b.*$")  # at the end of a step's text
ARGUMENTS: contextvars.ContextVar[Sequence[str]] = contextvars.ContextVar("ARGUMENTS", default=())


def stderr() -> Console:
    """Where messages go. A notebook's command line has a pseudo-terminal that shows every line."""
    return Console(stderr=True, force_terminal=False if "JPY_PARENT_PID" in os.environ else None)


@contextmanager
def steps(console: Console | None = None) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the current step of a command until the block ends.

    A terminal has one line that changes. Elsewhere a step prints one line after ``LINE_AFTER_S``.
    Texts that differ only in an amount at the end, as in ``run 1: 3 s flown``, belong to one step.

    Args:
        console: that of stderr if not given.
    """
    console = console or stderr()
    if console.is_terminal:
        with console.status("starting") as status:
            yield status.update
        return
    lines = _Lines(console)
    try:
        yield lines.report
    finally:
        lines.timer.cancel()


class _Lines:
    """Prints the latest text of a step once, ``LINE_AFTER_S`` after the step began."""

    def __init__(self, console: Console) -> None:
        self._console, self._step, self._text = console, "", ""
        self.timer = threading.Timer(LINE_AFTER_S, self._print)

    def report(self, text: str) -> None:
        """Set the text; a new step restarts the timer, a new amount of the same step does not."""
        step, self._text = DURATION.sub("", text), text
        if step != self._step:
            self._step = step
            self.timer.cancel()
            self.timer = threading.Timer(LINE_AFTER_S, self._print)
            self.timer.daemon = True
            self.timer.start()

    def _print(self) -> None:
        self._console.print(self._text, highlight=False, markup=False, soft_wrap=True)


def note(text: str) -> None:
    """Print a line to stderr, apart from the results of a command."""
    stderr().print(text, highlight=False, markup=False, soft_wrap=True)


def wrote(*paths: Path | str | None) -> None:
    """Say which files a command has written; None is an output that was not asked for."""
    for path in paths:
        if path is not None:
            note(f"wrote {path}")


def resuming_command() -> str:
    """The command line that was given, with ``--resume`` and without ``--overwrite``."""
    arguments = [x for x in ARGUMENTS.get() if x not in ("--overwrite", "--resume")]
    return shlex.join([*arguments, "--resume"])
