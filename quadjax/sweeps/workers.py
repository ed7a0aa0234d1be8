"""Workers of a sweep: processes that take trials from its study until none waits."""

import math
import multiprocessing
import os
import signal
import statistics
import subprocess
import threading
import time
import traceback
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import psutil

from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions
from quadjax.sweeps.extra import optuna
from quadjax.sweeps.study import count, is_duplicate, open_study
from quadjax.sweeps.sweep import Sweep
from quadjax.sweeps.trial import Job, Outcome, Tell, job_of

SPAWN = multiprocessing.get_context("spawn")  # JAX does not support fork
MEMORY = 0.9  # fraction of a GPU's memory that its trials share
Function = Callable[[Job, Tell], Outcome]


class TrialFailed(Exception):
    """A trial without a value; it is queued again unless its user attribute ``error`` is set."""


def work(
    sweep: Sweep, directory: Path, function: Function, end: float, slot: int, name: str
) -> None:
    """Run the trials that wait, one after another.

    Args:
        sweep: the sweep.
        directory: of its results.
        function: runs a trial.
        end: wall time, s, after which no trial starts.
        slot: number of the worker, which changes the seed of the sampler.
        name: of the worker, for its trials' user attribute ``worker``.
    """
    study = open_study(sweep, directory, run=False, slot=slot)

    def objective(trial: optuna.Trial) -> float:
        trial.set_user_attr("worker", name)
        try:
            return run_one(sweep, directory, function, stop, trial)
        except (TrialFailed, optuna.TrialPruned):
            raise
        except Exception:  # the trial stays in the state of a worker that died
            traceback.print_exc()
            os._exit(1)

    with interruptions(b"") as stop:
        while not stop.is_set() and time.time() < end and count(study).waiting:
            study.optimize(objective, n_trials=1, catch=(TrialFailed,))


def run_one(
    sweep: Sweep,
    directory: Path,
    function: Function,
    stop: threading.Event,
    trial: optuna.Trial,
) -> float:
    """The value of a trial; its measurements become user attributes."""
    if "index" not in trial.user_attrs or is_duplicate(trial):
        raise TrialFailed
    started, pruned, last = time.monotonic(), False, -1

    def tell(step: int, value: float) -> bool:
        nonlocal pruned, last
        if step > last and not pruned:
            trial.report(value, step)
            pruned, last = trial.should_prune(), step
        return pruned or stop.is_set()

    try:
        params = {d.key: d.suggest(trial) for d in sweep.dimensions}
        outcome = function(job_of(sweep, params, trial.user_attrs["index"], directory), tell)
    except InputError as error:
        outcome = Outcome((), 0.0, False, str(error))
    attributes = {
        "values": list(outcome.values),
        "finished": outcome.finished,
        "host": outcome.host,
        "seconds": round(time.monotonic() - started, 1),
    }
    for key, value in (attributes | ({"error": outcome.error} if outcome.error else {})).items():
        trial.set_user_attr(key, value)
    if pruned:
        raise optuna.TrialPruned
    if not outcome.complete:
        raise TrialFailed
    return statistics.median(outcome.values)


class LocalWorkers:
    """Processes of this machine, each pinned to one core, or with GPUs of its own."""

    def __init__(self, sweep: Sweep, directory: Path, function: Function, end: float) -> None:
        """Prepare; ``InputError`` for more workers than there are cores, or GPUs for them."""
        asked, process = sweep.file.executor, psutil.Process()
        self._cores: list[int] = process.cpu_affinity() if hasattr(process, "cpu_affinity") else []
        room, what = len(self._cores) or psutil.cpu_count() or 1, "the cores of this process"
        self._gpus: list[str] = []
        if asked.gpus:
            gpus, self._cores = visible_gpus(), []
            room, what = int(len(gpus) / asked.gpus + 1e-9), f"what {len(gpus)} GPUs have room for"
            firsts = [int(slot * asked.gpus + 1e-9) for slot in range(room)]
            each = math.ceil(asked.gpus)
            self._gpus = [",".join(gpus[first : first + each]) for first in firsts]
        self.count = asked.workers or room
        if self.count > room or not room:
            key, value = ("workers", asked.workers) if room else ("gpus", asked.gpus)
            raise InputError(f"executor.{key} is {value:g}, allowed: up to {room}, {what}")
        self._share = asked.gpus
        self._logs = directory / "logs"
        self._arguments = (sweep, directory, function, end)

    def start(self, slot: int, name: str) -> BaseProcess:
        """Start a worker."""
        self._logs.mkdir(parents=True, exist_ok=True)
        core = self._cores[slot] if self._cores else None
        gpu = self._gpus[slot] if self._gpus else None
        log = self._logs / f"worker{slot}.log"
        arguments = (log, core, gpu, self._share, *self._arguments, slot, name)
        process = SPAWN.Process(target=_serve, args=arguments, name=str(log), daemon=True)
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
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return []
    return [str(number) for number, _ in enumerate(listed.stdout.splitlines())]


def _serve(log: Path, core: int | None, gpu: str | None, share: float, *arguments: Any) -> None:
    """The main function of a process: pin it, send its output to a log, and work."""
    os.setsid()  # Ctrl-C is handled by the parent
    if core is not None:
        psutil.Process().cpu_affinity([core])
    stream = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666)
    os.dup2(stream, 1)
    os.dup2(stream, 2)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    use_device(gpu, share)
    work(*arguments)


def use_device(gpu: str | None, share: float) -> None:
    """Choose JAX's device before its first use: a GPU and a part of its memory, or the CPU."""
    import jax

    if gpu is None:
        jax.config.update("jax_platforms", "cpu")
        return
    os.environ["CUDA_VISIBLE_DEVICES"] = gpu
    if share < 1:  # JAX allocates three quarters of a GPU's memory by default
        os.environ.setdefault("XLA_PYTHON_CLIENT_MEM_FRACTION", f"{MEMORY * share:.3f}")


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os.kill(os.getpid(), signal.SIGTERM)
