"""Where the trials of a sweep run: processes of this machine, or tasks on a Ray cluster."""

import contextlib
import math
import multiprocessing
import os
import signal
import subprocess
import threading
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import psutil

from quadjax.core.errors import InputError
from quadjax.sweeps.schema import Executor

SPAWN = multiprocessing.get_context("spawn")  # JAX does not support fork
MEMORY_FRACTION = 0.9  # of a GPU's memory that its trials share


class LocalWorkers:
    """Processes of this machine, each pinned to one core, or with GPUs of its own."""

    def __init__(self, executor: Executor, logs: Path) -> None:
        """Prepare; ``InputError`` for more workers than there are cores, or GPUs for them."""
        process, n = psutil.Process(), executor.gpus
        pinned = hasattr(process, "cpu_affinity")
        cores = process.cpu_affinity() if pinned else [None] * (psutil.cpu_count() or 1)
        self._places: list[tuple[int | None, str]] = [(core, "") for core in cores]
        what = "the cores of this process"
        if n:
            gpus = visible_gpus()
            firsts = [int(slot * n + 1e-9) for slot in range(int(len(gpus) / n + 1e-9))]
            self._places = [(None, ",".join(gpus[i : i + math.ceil(n)])) for i in firsts]
            what = f"room on {len(gpus)} GPUs for executor.gpus {n:g}"
        room = len(self._places)
        self.count, self._share, self._logs = executor.workers or room, n, logs
        if self.count > room or not room:
            raise InputError(f"executor.workers is {self.count}, allowed: up to {room}, {what}")

    def start(self, slot: int, function: Callable[..., None], *arguments: Any) -> BaseProcess:
        """Call a function in a worker."""
        self._logs.mkdir(parents=True, exist_ok=True)
        log = self._logs / f"worker{slot}.log"
        task = (log, *self._places[slot], self._share, function, *arguments)
        process = SPAWN.Process(target=_serve, args=task, name=str(log), daemon=True)
        process.start()
        return process

    def reason(self, process: BaseProcess) -> str | None:
        """None while a worker runs; "" if it ended by itself; else why it died."""
        if process.is_alive():
            return None
        code = process.exitcode
        return f"worker died (exit code {code}; see {process.name})" if code else ""

    def stop(self, process: BaseProcess) -> None:
        """Ask a worker to save its trial and to end."""
        process.terminate()


def visible_gpus() -> list[str]:
    """The GPUs of this machine, as ``CUDA_VISIBLE_DEVICES`` names them."""
    if (visible := os.environ.get("CUDA_VISIBLE_DEVICES")) is not None:
        return [name for name in visible.split(",") if name]
    with contextlib.suppress(OSError, subprocess.CalledProcessError):
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True)
        return [str(number) for number, _ in enumerate(listed.stdout.splitlines())]
    return []


def _serve(
    log: Path,
    core: int | None,
    gpus: str,
    share: float,
    function: Callable[..., None],
    *arguments: Any,
) -> None:
    """The main function of a process: pin it, send its output to a log, and work."""
    os.setsid()  # Ctrl-C is handled by the parent
    if core is not None:
        psutil.Process().cpu_affinity([core])
    stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    os.dup2(stream, 1)
    os.dup2(stream, 2)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _call(gpus, share, function, *arguments)


def _call(gpus: str, share: float, function: Callable[..., None], *arguments: Any) -> None:
    """Choose JAX's devices before its first use: GPUs and a part of their memory, or the CPU."""
    import jax

    if gpus:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus
        if share < 1:  # JAX allocates three quarters of a GPU's memory by default
            os.environ.setdefault(
                "XLA_PYTHON_CLIENT_MEM_FRACTION", f"{MEMORY_FRACTION * share:.3f}"
            )
    else:
        jax.config.update("jax_platforms", "cpu")
    function(*arguments)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


class RayWorkers:
    """Tasks on a Ray cluster. The output folder must be on a file system that all nodes share."""

    def __init__(self, executor: Executor) -> None:
        """Connect to the cluster; ``InputError`` where none answers or has room for a trial."""
        try:
            import ray
        except ImportError:
            raise InputError("executor.kind is ray: pip install 'quadjax[ray]'") from None

        if not ray.is_initialized():
            try:
                ray.init(address=executor.address, log_to_driver=False)
            except (ConnectionError, ValueError) as error:
                hint = "no Ray cluster answers; start one with ray start --head"
                raise InputError(f"executor.address is {executor.address}: {hint}") from error
        need = {"CPU": executor.cpus, "GPU": executor.gpus}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        room = sum(
            min(int(node.get(kind, 0.0) / n + 1e-9) for kind, n in need.items() if n)
            for node in nodes
        )
        if not room:
            text = f"{executor.cpus:g} CPUs and {executor.gpus:g} GPUs"
            raise InputError(f"executor: no node has {text}")
        self._ray, self.count, self._share = ray, executor.workers or room, executor.gpus
        options = {"num_cpus": executor.cpus, "num_gpus": executor.gpus, "max_retries": 0}
        self._task = ray.remote(_task).options(**options)  # the study retries

    def start(self, slot: int, function: Callable[..., None], *arguments: Any) -> Any:
        """Call a function as soon as a node has room for it."""
        return self._task.remote(self._share, function, *arguments)

    def reason(self, task: Any) -> str | None:
        """As of ``LocalWorkers``."""
        if not self._ray.wait([task], timeout=0)[0]:
            return None
        try:
            self._ray.get(task)
        except self._ray.exceptions.RayError as error:
            lines = str(error).strip().splitlines() or [""]
            return f"{type(error).__name__}: {lines[-1]}"
        return ""

    def stop(self, task: Any) -> None:
        """Ask a worker to save its trial and to end."""
        self._ray.cancel(task)


def _task(share: float, function: Callable[..., None], *arguments: Any) -> None:
    import ray

    _call(",".join(map(str, ray.get_gpu_ids())), share, function, *arguments)
