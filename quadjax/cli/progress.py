"""The present step of a command, for commands that take longer than some seconds."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console

SECONDS = 5.0  # between lines where there is no terminal


@contextmanager
def steps(console: Console) -> Iterator[Callable[[str], None]]:
    """Yield a function that shows the present step of a command until the block ends.

    A terminal has one line that changes. Elsewhere it prints lines, at most one in ``SECONDS``.
    """
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
