"""Ctrl-C and termination requests: as an event for a training loop, and during imports."""

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from quadjax.core.errors import INTERRUPTED

STOPPING = b"\nstopping: saved after the next evaluation; Ctrl-C again ends without saving\n"
Handler = Callable[[int, FrameType | None], object] | int | None


@contextmanager
def interruptions(message: bytes = STOPPING) -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets; a second one raises ``KeyboardInterrupt``.

    The first one prints a line, ``message``, to stderr.
    The handler that was installed before is called at the first signal, too.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def ask(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()
        os.write(2, message)
        handler = before[number]
        if callable(handler) and handler is not signal.default_int_handler:
            handler(number, frame)

    before: dict[int, Handler] = {
        number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def uninterrupted() -> Iterator[list[int]]:
    """Defer Ctrl-C and SIGTERM to the end of a short block, so that it runs completely.

    Yields the signals received so far.
    """
    received: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield received
        return
    before = {
        number: signal.signal(number, lambda number, frame: received.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield received
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])


@contextmanager
def loading() -> Iterator[None]:
    """End the process at once on Ctrl-C, for use around imports.

    An exception in the middle of the import of an extension module can be swallowed, or crash the
    interpreter. During imports there is nothing to save.
    """

    def leave(number: int, frame: FrameType | None) -> None:
        os.write(2, b"interrupted\n")
        os._exit(INTERRUPTED)

    if (
        threading.current_thread() is not threading.main_thread()
        or signal.getsignal(signal.SIGINT) is not signal.default_int_handler
    ):
        yield
        return
    signal.signal(signal.SIGINT, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)
