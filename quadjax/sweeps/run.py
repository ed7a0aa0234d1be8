"""Running a sweep: workers on this machine or a cluster, until no trial waits."""

import contextlib
import datetime
import math
import sys
import time
import uuid
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadjax.core.interruptions import interruptions
from quadjax.sweeps.extra import optuna
from quadjax.sweeps.study import (
    Counts,
    count,
    fail_running,
    is_journal,
    open_study,
    storage_errors,
)
from quadjax.sweeps.sweep import Sweep
from quadjax.sweeps.trial import run_trial
from quadjax.sweeps.workers import Function, LocalWorkers

if TYPE_CHECKING:
    from quadjax.sweeps.cluster import RayWorkers

POLL_SECONDS = 0.2


def make_workers(
    sweep: Sweep, directory: Path, function: Function = run_trial
) -> "LocalWorkers | RayWorkers":
    """The workers that the sweep file selects; ``function`` runs a trial there."""
    seconds = sweep.file.budget.seconds
    end = math.inf if seconds is None else time.time() + seconds
    if sweep.file.executor.kind == "local":
        return LocalWorkers(sweep, directory.resolve(), function, end)
    from quadjax.sweeps.cluster import RayWorkers

    return RayWorkers(sweep, directory.resolve(), function, end)


def run_sweep(sweep: Sweep, directory: Path, workers: "LocalWorkers | RayWorkers") -> bool:
    """Run the trials of the queue until it is empty or the time is over; False after Ctrl-C."""
    study, started = open_study(sweep, directory), time.monotonic()
    first, seconds = count(study), sweep.file.budget.seconds
    shown, stopped = first, False
    running: dict[int, tuple[str, Any]] = {}
    guard = contextlib.nullcontext() if is_journal(sweep) else storage_errors(sweep, directory)
    with interruptions() as stop, guard:
        while (now := count(study)).waiting + now.running or running:
            elapsed = time.monotonic() - started
            over = stop.is_set() or (seconds is not None and elapsed > seconds)
            if now != shown:
                shown, text = now, progress(now, first.done, elapsed)
                print(f"{sweep.file.name}: {text}", file=sys.stderr, flush=True)
            for slot in range(0 if over else min(workers.count, now.waiting + len(running))):
                if slot not in running:
                    name = uuid.uuid4().hex
                    running[slot] = name, workers.start(slot, name)
            if stop.is_set() and not stopped:
                stopped = True
                for _, worker in running.values():
                    workers.stop(worker)
            for slot, (name, worker) in list(running.items()):
                if (reason := workers.reason(worker)) is not None:
                    del running[slot]
                    fail_running(study, sweep, reason if not stopped else "", name)
            if over and not running:
                break
            if not running and is_journal(sweep):
                fail_running(study, sweep, "worker died")
            elif not running:  # other machines run the rest
                optuna.storages.fail_stale_trials(study)
            time.sleep(POLL_SECONDS)
    return not stop.is_set()


def progress(counts: Counts, before: int, seconds: float) -> str:
    """Trials done, the best value, and the time left at ``seconds`` since ``before`` were done."""
    open_trials = counts.running + counts.waiting
    text = f"{counts.done}/{counts.done + counts.failed + open_trials} trials, "
    text += "no flight finished yet" if counts.best is None else f"best {counts.best:.2f} s"
    text += f", {counts.failed} failed" if counts.failed else ""
    if counts.done > before:
        left = datetime.timedelta(seconds=round(seconds / (counts.done - before) * open_trials))
        text += f", about {left} left"
    return text
