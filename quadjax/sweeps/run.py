"""Running a sweep: workers take trials from its study until none waits."""

import contextlib
import datetime
import math
import socket
import statistics
import sys
import threading
import time
import traceback
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import optuna

from quadjax.config.assembly import make_params
from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions
from quadjax.sweeps.study import (
    OPEN,
    OVER,
    State,
    count,
    latest_trials,
    open_study,
    progress,
    retry_running,
    storage_errors,
)
from quadjax.sweeps.sweep import Params, Sweep
from quadjax.sweeps.workers import LocalWorkers, RayWorkers

POLL_SECONDS = 0.2
REPORTS = 10  # to the pruner in each training
FLIGHT_SEED = 1
Enough = Callable[[float, float], bool]  # (fraction of the training, lap time): whether to stop
# (sweep, parameters, index, seed, folder, enough): value, s, and the fraction of finished flights
# of one seed of a trial; None if it was stopped.
Measure = Callable[[Sweep, Params, int, int, Path, Enough], tuple[float, float] | None]


class TrialFailed(Exception):
    """A trial without a value; it is queued again unless its user attribute ``error`` is set."""


def train_and_fly(
    sweep: Sweep, params: Params, index: int, seed: int, folder: Path, enough: Enough
) -> tuple[float, float] | None:
    """Train one seed, from its checkpoint if there is one, and evaluate its policy: ``Measure``."""
    from quadjax.evaluation.evaluate import evaluate
    from quadjax.learners.loop import NonFiniteError
    from quadjax.race.laps import race_length, time_limit
    from quadjax.training.run import train

    run, asked = (f"name=trial{index:04d}", "run.devices=1"), sweep.file.objective
    config = sweep.config_of(params, *run, f"seed={seed}")
    race = sweep.config_of(params, *run, *sweep.conditions) if asked.plant is None else config
    track, laps = make_params(config).track, config.evaluate
    limit = time_limit(track, race_length(track, laps.laps, laps.gates))

    def row_enough(row: dict[str, float]) -> bool:
        return enough(row["steps"] / config.run.steps, min(row["best_lap_total"], limit))

    try:
        if not train(config, folder, resume=True, enough=row_enough).finished:
            return None
    except NonFiniteError:
        return limit, 0.0
    result = evaluate(
        folder / ("policy.npz" if asked.policy == "best" else "policy_last.npz"),
        race,
        plant=asked.plant,
        plants=None if asked.plant is None else asked.plants,
        runs=asked.runs,
        deterministic=asked.deterministic,
        seed=FLIGHT_SEED,
    )
    return result.laps.penalized, result.finished / asked.runs


def objective(
    trial: optuna.Trial, sweep: Sweep, directory: Path, measure: Measure, stop: threading.Event
) -> float:
    """The median of a trial's seeds, s; what was measured becomes its user attributes."""
    index, last, pruned = trial.user_attrs.get("index"), 0, False
    if index is None or latest_trials(trial.study)[index].number != trial.number:
        raise TrialFailed
    values: list[float] = []
    finished, started, seeds = 0.0, time.monotonic(), range(sweep.file.objective.seeds)

    def enough(fraction: float, lap_time: float) -> bool:
        nonlocal last, pruned
        step = int((len(values) + min(fraction, 1.0)) * REPORTS + 1e-9)
        if step > last and not pruned:
            trial.report(statistics.median([*values, lap_time]), step)
            last, pruned = step, trial.should_prune()
        return pruned or stop.is_set()

    try:
        params = sweep.suggest(trial)
        for seed in seeds:
            folder = directory.resolve() / "trials" / f"{index:04d}" / f"seed{seed}"
            if (result := measure(sweep, params, index, seed, folder, enough)) is None:
                break
            values, finished = [*values, result[0]], finished + result[1]
    except Exception as error:
        traceback.print_exc()
        kind = "" if isinstance(error, InputError) else f"{type(error).__name__}: "
        trial.set_user_attr("error", f"{kind}{error}".partition("\n")[0])
    attrs = {"values": values, "finished": finished / max(len(values), 1)}
    attrs |= {"host": socket.gethostname(), "seconds": round(time.monotonic() - started, 1)}
    for key, value in attrs.items():
        trial.set_user_attr(key, value)
    if pruned:
        raise optuna.TrialPruned
    if len(values) < len(seeds):
        raise TrialFailed
    return statistics.median(values)


def work(sweep: Sweep, directory: Path, measure: Measure, end: float, slot: int, name: str) -> None:
    """Run the trials that wait, one after another.

    Args:
        sweep: the sweep.
        directory: of its results.
        measure: runs one seed of a trial.
        end: wall time, s, after which no trial starts.
        slot: number of the worker, which changes the seed of the sampler.
        name: of the worker, for its trials' user attribute ``worker``.
    """
    study = open_study(sweep, directory, run=False, slot=slot)
    with interruptions(b"") as stop:

        def run_one(trial: optuna.Trial) -> float:
            trial.set_user_attr("worker", name)
            return objective(trial, sweep, directory, measure, stop)

        while not stop.is_set() and time.time() < end and study.get_trials(False, (State.WAITING,)):
            study.optimize(run_one, n_trials=1, catch=TrialFailed)


def run_sweep(
    sweep: Sweep, directory: Path, workers: LocalWorkers | RayWorkers, measure: Measure
) -> bool:
    """Run the trials of the queue until it is empty or the time is over; False after Ctrl-C."""
    study, started = open_study(sweep, directory), time.monotonic()
    seconds, journal = sweep.file.budget.seconds or math.inf, sweep.file.storage == "journal"
    arguments = (sweep, directory.resolve(), measure, time.time() + seconds)
    first = printed = count(study)
    running: dict[int, tuple[str, Any]] = {}
    guard = contextlib.nullcontext() if journal else storage_errors(sweep, directory)
    with interruptions() as stop, guard:
        while (left := sum((now := count(study))[state] for state in OPEN)) or running:
            elapsed, interrupted = time.monotonic() - started, stop.is_set()
            over = interrupted or elapsed > seconds
            if now != printed:
                printed, text = now, f"{sweep.file.name}: {progress(study)}"
                if done := sum(now[state] - first[state] for state in OVER):
                    text += (
                        f", about {datetime.timedelta(seconds=round(elapsed / done * left))} left"
                    )
                print(text, file=sys.stderr, flush=True)
            for slot in range(0 if over else min(workers.count, now[State.WAITING] + len(running))):
                if slot not in running:
                    name = uuid.uuid4().hex
                    running[slot] = name, workers.start(slot, work, *arguments, slot, name)
            for slot, (name, worker) in list(running.items()):
                if interrupted:
                    workers.stop(worker)
                if (reason := workers.reason(worker)) is not None:
                    del running[slot]
                    if reason and not interrupted:
                        retry_running(study, sweep, reason, name)
            if over and not running:
                break
            if not running and journal:
                retry_running(study, sweep, "worker died", None)
            elif not running:  # other machines run the rest
                optuna.storages.fail_stale_trials(study)
            time.sleep(POLL_SECONDS)
    return not stop.is_set()
