"""Ctrl-C and termination requests: as an event for a training loop, and during imports."""

import _thread
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

from quadjax.core.errors import INTERRUPTED

STOPPING = (
    b"\nstopping after the next evaluation; a compilation ends after 5 s, without saving; "
    b"Ctrl-C again ends without saving\n"
)
REPEAT_AFTER_S = 0.05  # after which a lost interruption is repeated
Handler = Callable[[int, FrameType | None], object] | int | None


@contextmanager
def _handled(handler: Callable[[int, FrameType | None], object]) -> Iterator[dict[int, Handler]]:
    """Call a function on Ctrl-C and SIGTERM in the block; yields the previous handlers."""
    if threading.current_thread() is not threading.main_thread():
        yield {}
        return
    before: dict[int, Handler] = {
        number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield before
    finally:
        for number, handler_before in before.items():
            signal.signal(number, handler_before)


@contextmanager
def interruptions(message: bytes = STOPPING) -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets; a second one raises ``KeyboardInterrupt``.

    The first one prints a line, ``message``, to stderr.
    The handler that was installed before is called at the first signal, too.
    """
    stop, before = threading.Event(), dict[int, Handler]()

    def ask(number: int, frame: FrameType | None) -> None:
        if stop.is_set():
            raise KeyboardInterrupt
        stop.set()
        os.write(2, message)
        handler = before.get(number)
        if callable(handler) and handler is not signal.default_int_handler:
            handler(number, frame)

    with _handled(ask) as handlers:
        before |= handlers
        yield stop


def repeat_lost() -> None:
    """Repeat a ``KeyboardInterrupt`` from where Python ignores it, as in a callback of JAX."""
    before = sys.unraisablehook

    def hook(lost: "sys.UnraisableHookArgs") -> None:
        if not issubclass(lost.exc_type, KeyboardInterrupt):
            before(lost)
            return
        again = threading.Timer(REPEAT_AFTER_S, _thread.interrupt_main)
        again.daemon = True
        again.start()

    sys.unraisablehook = hook


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Defer Ctrl-C and SIGTERM to the end of a short block, so that it runs completely."""
    received: list[int] = []
    try:
        with _handled(lambda number, frame: received.append(number)):
            yield
    finally:
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
