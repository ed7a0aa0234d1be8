"""Running a sweep on this machine: workers started, tended, shown and stopped."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions
from quadjax.sweeps.machine import Layout
from quadjax.sweeps.progress import SweepProgress
from quadjax.sweeps.schema import Sweep
from quadjax.sweeps.store import Counts, Store

WORKER = "quadjax.sweeps.worker"  # the module that a worker runs
POLL_SECONDS = 0.25
TEND_SECONDS = 2.0
STOP_SECONDS = 30.0  # for workers to save what they are at
FRUITLESS = 3  # workers in a row that end without a trial: something is wrong with all of them


class WorkersFailError(RuntimeError):
    """Workers end without doing anything; says why."""


@dataclasses.dataclass
class Running:
    """A worker's process, on its place."""

    process: subprocess.Popen
    place: int
    log: Path


@dataclasses.dataclass
class Crew:
    """The workers of this machine."""

    command: dict[str, object]  # of every worker: what to do
    layout: Layout
    logs: Path
    there: list[Running] = dataclasses.field(default_factory=list)
    fruitless: int = 0

    def start(self) -> None:
        """One more worker, on the first free place."""
        place = min(set(range(self.layout.workers)) - {w.place for w in self.there})
        job = self.command | {"core": self.layout.cores[place]}
        environment = dict(os.environ)
        gpu = self.layout.accelerators[place]
        if gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = str(gpu)
        path = [str(Path(__file__).resolve().parents[2]), environment.get("PYTHONPATH", "")]
        environment["PYTHONPATH"] = os.pathsep.join(filter(None, path))
        log = self.logs / f"worker{place}.log"
        with open(log, "ab") as stream:
            process = self._spawn(job, environment, stream)
        self.there.append(Running(process, place, log))

    def _spawn(
        self, job: dict[str, object], environment: dict[str, str], stream: IO[bytes]
    ) -> subprocess.Popen:
        return subprocess.Popen(
            [sys.executable, "-m", WORKER, "--job", json.dumps(job)],
            stdout=stream,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            env=environment,
            start_new_session=True,  # Ctrl-C comes to this process, which tells them
        )

    def look(self, store: Store) -> None:
        """Forget workers that have ended.

        Raises:
            WorkersFailError: several in a row failed before they took a trial.
        """
        for worker in [w for w in self.there if w.process.poll() is not None]:
            self.there.remove(worker)
            bad = worker.process.returncode != 0 and not store.has_run(worker.process.pid)
            self.fruitless = self.fruitless + 1 if bad else 0
            if self.fruitless >= FRUITLESS:
                raise WorkersFailError(f"workers fail: {_last_line(worker.log)} ({worker.log})")

    def stop(self) -> None:
        """Ask all workers to save and end; after a while, insist."""
        for worker in self.there:
            worker.process.send_signal(signal.SIGTERM)
        deadline = time.monotonic() + STOP_SECONDS
        for worker in self.there:
            try:
                worker.process.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                worker.process.kill()
                worker.process.wait()


def _last_line(path: Path) -> str:
    lines = path.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else "no message"


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How a sweep ended."""

    counts: Counts
    interrupted: bool
    out_of_time: bool
    seconds: float


def run_sweep(
    store: Store, sweep_file: Path | str, words: Sequence[str], runs: Path, layout: Layout
) -> Outcome:
    """Run trials until the budget is spent, the time is over or Ctrl-C.

    Args:
        store: the sweep's, opened.
        sweep_file: for the workers.
        words: changes to it.
        runs: the folder of all runs.
        layout: workers, and runs at once in each.

    Raises:
        WorkersFailError: no worker gets anywhere.
        InputError: the study has been given more trials than the budget says.
    """
    began = time.monotonic()
    limit = store.sweep.file.budget.seconds
    deadline = time.time() + (limit if limit is not None else 1e9)
    logs = store.directory / "logs"
    logs.mkdir(exist_ok=True)
    command = {
        "sweep": str(sweep_file),
        "words": list(words),
        "runs": str(runs),
        "parent": os.getpid(),
        "lanes": layout.lanes,
        "deadline": deadline,
    }
    crew, counts = Crew(command, layout, logs), store.tend()
    with interruptions() as stop, SweepProgress(store.sweep, counts) as show:
        try:
            counts = _loop(store, crew, counts, stop.is_set, deadline, show)
        finally:
            crew.stop()
    counts = store.tend(stopped=True)
    out_of_time = counts.open > 0 and not stop.is_set()
    return Outcome(counts, stop.is_set(), out_of_time, time.monotonic() - began)


def _loop(
    store: Store,
    crew: Crew,
    counts: Counts,
    stopped: object,
    deadline: float,
    show: SweepProgress,
) -> Counts:
    tended = time.monotonic()
    while counts.open and not stopped():
        over = time.time() >= deadline
        if over and not crew.there:
            return counts
        wanted = 0 if over else min(crew.layout.workers, counts.waiting + len(crew.there))
        while len(crew.there) < wanted:
            crew.start()
        time.sleep(POLL_SECONDS)
        before = len(crew.there)
        crew.look(store)
        if len(crew.there) != before or time.monotonic() - tended > TEND_SECONDS:
            counts, tended = store.tend(), time.monotonic()
            show.show(counts)
    return counts


def check_budget(sweep: Sweep, counts: Counts) -> None:
    """Raise an ``InputError`` where the study holds more slots than the budget."""
    slots = counts.done + counts.open + counts.failed
    if slots > sweep.trials:
        raise InputError(
            f"the study {sweep.file.name} holds {slots} trials, budget.trials is {sweep.trials}: "
            "a budget can grow, not shrink"
        )
