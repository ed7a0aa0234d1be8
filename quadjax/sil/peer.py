"""The autopilot at the other end of the socket: a process of the exported C, or the user's own.

UDP on the loopback interface: a datagram is a message, a late message does not hold up the ones
after it, and the socket reports at once if the other end is gone.
"""

import contextlib
import select
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.sil.message import CommandKind, Kind, MessageError, new, pack, unpack

ADDRESS = "127.0.0.1"
CONNECT_SECONDS = 120.0  # to wait for a user's autopilot
START_SECONDS = 10.0  # to wait for the exported C
SLICE = 0.1  # s between looks at whether to stop
BYTES = 4096


class Gone(InputError):
    """The autopilot is gone, or silent."""


class Peer:
    """An autopilot that has said hello.

    Attributes:
        rejected: number of messages by the reason for which they were rejected.
        rejected_before: number of states that the autopilot rejected in the races before.
    """

    def __init__(self, connection: socket.socket, name: str, stop: threading.Event) -> None:
        """Use a socket that is connected to the autopilot ``name``; ``stop`` ends all waiting."""
        self.rejected: Counter[str] = Counter()
        self.rejected_before = 0
        self._socket, self._name, self._stop = connection, name, stop

    @property
    def stopped(self) -> bool:
        """Whether the race is to end."""
        return self._stop.is_set()

    def send(self, data: bytes) -> None:
        """Send a datagram.

        Raises:
            Gone: nobody listens at the other end.
        """
        try:
            self._socket.send(data)
        except ConnectionRefusedError:
            raise self.gone("is gone") from None

    def receive(self, until: float) -> np.ndarray | None:
        """The next intact command that arrives before a time of ``time.monotonic()``, else None.

        Raises:
            Gone: nobody listens at the other end, or it says that it ends.
        """
        while not self._stop.is_set():
            left = until - time.monotonic()
            if not _readable(self._socket, min(max(left, 0.0), SLICE)):
                if left <= SLICE:
                    return None
                continue
            try:
                data = self._socket.recv(BYTES)
            except ConnectionRefusedError:
                raise self.gone("is gone") from None
            try:
                message = unpack(data)
                if message["kind"] == Kind.END:
                    raise self.gone("has ended")
                if message["kind"] != Kind.COMMAND:
                    raise MessageError("no command")
                return message
            except MessageError as error:
                self.rejected[str(error)] += 1
        return None

    def gone(self, how: str) -> Gone:
        """The error of an autopilot that is gone or silent."""
        return Gone(f"autopilot {self._name}: {how}")

    def end(self) -> None:
        """Tell the autopilot that there are no more states."""
        with contextlib.suppress(OSError):
            self._socket.send(pack(new(Kind.END)))


def _readable(connection: socket.socket, seconds: float) -> bool:
    return bool(select.select([connection], [], [], seconds)[0])


@contextlib.contextmanager
def listening(host: str, port: int) -> Iterator[socket.socket]:
    """A socket at an address; port 0 is any free one.

    Raises:
        InputError: a port that is taken, or no such address.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as connection:
        try:
            connection.bind((host, port))
        except OSError as error:
            raise InputError(
                f"--listen {host}:{port}: cannot listen there ({error.strerror or error})"
            ) from None
        yield connection


@contextlib.contextmanager
def greeted(
    connection: socket.socket, kind: CommandKind, seconds: float, stop: threading.Event
) -> Iterator[Peer]:
    """The autopilot that says hello at a socket within some seconds, or until ``stop``.

    ``kind`` is that of the commands that the drone takes.

    Raises:
        InputError: no hello, or one of another version, for another drone, or after a self-test
            that failed.
    """
    until = time.monotonic() + seconds
    while not _readable(connection, SLICE):
        if stop.is_set():
            raise KeyboardInterrupt
        if time.monotonic() > until:
            host, port = connection.getsockname()
            raise InputError(f"no autopilot has connected to {host}:{port} within {seconds:g} s")
    data, (host, port) = connection.recvfrom(BYTES)
    name = f"{host}:{port}"
    try:
        _check_hello(unpack(data), kind)
    except MessageError as error:
        raise InputError(f"autopilot {name}: first message rejected: {error}") from None
    connection.connect((host, port))
    peer = Peer(connection, name, stop)
    try:
        yield peer
    finally:
        peer.end()


def _check_hello(hello: np.ndarray, kind: CommandKind) -> None:
    """Raise a ``MessageError`` for a message that is no hello for this drone."""
    if hello["kind"] != Kind.HELLO:
        raise MessageError("no hello")
    if hello["command_kind"] != kind:
        wanted = f"{int(kind)} ({kind.name.lower()})"
        raise MessageError(f"command_kind {hello['command_kind']}, this drone takes {wanted}")
    if hello["self_test_mismatches"]:
        raise MessageError(f"{hello['self_test_mismatches']} self-test mismatches")


@contextlib.contextmanager
def running(program: Path, port: int) -> Iterator[subprocess.Popen]:
    """A process of the exported C that connects to a port of this machine.

    Its standard input is a pipe: it ends when this process ends, however that happens.
    """
    command = [str(program), ADDRESS, str(port)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True) as process:
        try:
            yield process
        finally:
            assert process.stdin is not None
            process.stdin.close()
            try:
                process.wait(1.0)
            except subprocess.TimeoutExpired:
                process.kill()
