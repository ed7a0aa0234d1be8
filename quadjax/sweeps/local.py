"""Trials in processes of this machine, each pinned to one core."""

import contextlib
import os
import queue
import signal
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

import psutil

from quadjax.core.errors import InputError
from quadjax.sweeps.schema import Executor
from quadjax.sweeps.trial import Job, Outcome, Tell

CONTEXT = get_context("spawn")  # JAX does not support fork
Function = Callable[[Job, Tell], Outcome]


class WorkerDied(RuntimeError):
    """The process or node of a trial has died."""


class LocalExecutor(contextlib.AbstractContextManager):
    """A worker process for each core, on the CPU; GPUs are Ray's."""

    def __init__(self, asked: Executor, function: Function, logs: Path) -> None:
        """Processes start with their first trial; ``InputError`` for more than there are cores."""
        process = psutil.Process()
        pinned = hasattr(process, "cpu_affinity")
        cores = process.cpu_affinity() if pinned else list(range(psutil.cpu_count() or 1))
        self.workers = asked.workers or len(cores)
        if self.workers > len(cores):
            most = f"{len(cores)}, the cores of this process"
            raise InputError(f"executor.workers is {self.workers}, allowed: up to {most}")
        logs.mkdir(parents=True, exist_ok=True)
        self._function = function
        self._free: queue.Queue[Worker] = queue.Queue()
        for i, core in enumerate(cores[: self.workers]):
            self._free.put(Worker(core, logs / f"worker{i}.log"))

    def run(self, job: Job, tell: Tell) -> Outcome:
        """Run a trial on a free worker; ``WorkerDied`` if its process ends before the trial."""
        worker = self._free.get()
        try:
            return worker.run(self._function, job, tell)
        finally:
            self._free.put(worker)

    def __exit__(self, *error: object) -> None:
        while not self._free.empty():
            self._free.get().pipe.close()  # its process ends


class Worker:
    """A process that runs one trial after another."""

    def __init__(self, core: int, log: Path) -> None:
        self._arguments, self._process = (core, str(log)), None
        self.pipe = CONTEXT.Pipe()[0]

    def run(self, function: Function, job: Job, tell: Tell) -> Outcome:
        """Run a trial, in a new process where the last one has ended."""
        if self._process is None or not self._process.is_alive():
            self.pipe, other = CONTEXT.Pipe()
            arguments = (other, *self._arguments)
            self._process = CONTEXT.Process(target=_serve, args=arguments, daemon=True)
            self._process.start()
            other.close()
        try:
            self.pipe.send((function, job))
            while not isinstance(message := self.pipe.recv(), Outcome):
                self.pipe.send(tell(*message))
        except (EOFError, OSError):
            self._process.join()
            reason = f"exit code {self._process.exitcode}; see {self._arguments[-1]}"
            raise WorkerDied(f"worker died ({reason})") from None
        return message


def _serve(pipe: Connection, core: int, log: str) -> None:
    """The main function of a worker: runs trials until the other end of the pipe is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is handled by the parent
    os.environ["JAX_PLATFORMS"] = "cpu"
    if hasattr(process := psutil.Process(), "cpu_affinity"):
        process.cpu_affinity([core])
    stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    os.dup2(stream, 1)
    os.dup2(stream, 2)

    def tell(step: int, value: float) -> bool:
        try:
            pipe.send((step, value))
            return pipe.recv()
        except (EOFError, OSError):  # the parent has died: save and stop
            return True

    try:
        while True:
            function, job = pipe.recv()
            pipe.send(function(job, tell))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
