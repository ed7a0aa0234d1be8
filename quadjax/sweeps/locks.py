"""Who works where, whether they still live, and locks that a killed process leaves open."""

import contextlib
import os
import socket
import zlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

try:
    import fcntl
except ImportError:  # not a POSIX system
    fcntl = None


class FileLock:
    """An exclusive lock on a file, which the system takes back when its holder dies.

    Usable as a context manager and, through ``acquire`` and ``release``, as Optuna's journal
    wants it. Not reentrant.
    """

    def __init__(self, path: Path | str) -> None:
        """Nothing is locked yet."""
        if fcntl is None:
            raise RuntimeError("sweeps need file locks, which this system does not have")
        self._path = str(path)
        self._handle: int | None = None

    def acquire(self) -> bool:
        """Wait for the lock."""
        handle = os.open(self._path, os.O_CREAT | os.O_RDWR, 0o666)
        fcntl.flock(handle, fcntl.LOCK_EX)
        self._handle = handle
        return True

    def release(self) -> None:
        """Let others in."""
        if self._handle is not None:
            handle, self._handle = self._handle, None
            os.close(handle)

    def __enter__(self) -> Self:
        """Wait for the lock."""
        self.acquire()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Let others in."""
        self.release()


@contextlib.contextmanager
def database_lock(engine: object, name: str) -> Iterator[None]:
    """An exclusive lock of a PostgreSQL database, freed when its connection ends.

    Args:
        engine: SQLAlchemy's.
        name: of the lock.
    """
    from sqlalchemy import text

    key = {"key": zlib.crc32(name.encode())}
    with engine.connect() as connection:
        connection.execute(text("select pg_advisory_lock(:key)"), key)
        try:
            yield
        finally:
            connection.execute(text("select pg_advisory_unlock(:key)"), key)


@dataclass(frozen=True)
class Worker:
    """A process that runs trials."""

    machine: str  # tells machines, and containers on one machine, apart
    host: str  # for people
    pid: int
    began: str  # tells processes of one number apart
    session: int  # pid of the process that started it
    session_began: str

    def to_json(self) -> dict[str, str | int]:
        """As a trial keeps it."""
        return asdict(self)


def this_worker(session: int | None = None) -> Worker:
    """This process as a worker, started by ``session``, or by itself."""
    session = os.getpid() if session is None else session
    return Worker(
        machine_id(),
        socket.gethostname(),
        os.getpid(),
        began(os.getpid()) or "",
        session,
        began(session) or "",
    )


def machine_id() -> str:
    """What processes that can see each other's numbers share."""
    parts = [socket.gethostname()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
    with contextlib.suppress(OSError):
        parts.append(os.readlink("/proc/self/ns/pid"))
    return " ".join(parts)


def began(pid: int) -> str | None:
    """When a process began, in the system's own units; None where there is no such process.

    A process that has ended and is only waited for does not count.
    """
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return None if fields[0] in "ZX" else fields[19]
    except (OSError, IndexError):
        if Path("/proc/self/stat").exists():
            return None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except PermissionError:
        pass
    return ""


def lives(worker: Worker) -> bool | None:
    """Whether a worker's process is there; None for one of another machine."""
    if worker.machine != machine_id():
        return None
    return began(worker.pid) == worker.began


def session_lives(worker: Worker) -> bool | None:
    """Whether the process that started a worker is there; None for one of another machine."""
    if worker.machine != machine_id():
        return None
    return began(worker.session) == worker.session_began
