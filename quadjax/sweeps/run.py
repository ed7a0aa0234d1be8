"""Running a sweep: workers take trials from its study until its budget is used up."""

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
from quadjax.sweeps.schema import JOURNAL
from quadjax.sweeps.study import (
    BEYOND,
    State,
    drop_partial_line,
    is_beyond,
    number_of,
    open_study,
    progress,
    retry,
    retry_running,
    storage_errors,
    trials_left,
    trials_over,
)
from quadjax.sweeps.sweep import Params, Sweep
from quadjax.sweeps.workers import LocalWorkers, RayWorkers

POLL_S = 0.2
PRINT_AFTER_S = 10.0  # after which the running trials are printed
REPORTS = 10  # to the pruner in each training
FLIGHT_SEED = 1
StopWhen = Callable[[float, float], bool]  # (fraction of the training, lap time): whether to stop
# (sweep, parameters, seed, folder, stop_when): value, s, and the fraction of finished flights of
# one seed of a trial; None if it was stopped.
Measure = Callable[[Sweep, Params, int, Path, StopWhen], tuple[float, float] | None]


class TrialStopped(Exception):
    """A trial without a value; it is queued again unless its user attribute ``error`` is set."""


def train_and_fly(
    sweep: Sweep, params: Params, seed: int, folder: Path, stop_when: StopWhen
) -> tuple[float, float] | None:
    """Train one seed, from its checkpoint if there is one, and evaluate its policy: ``Measure``."""
    from quadjax.evaluation.evaluate import evaluate
    from quadjax.learners.loop import NonFiniteError
    from quadjax.race.laps import race_length, time_limit
    from quadjax.training.run import train

    run = (f"name=trial{folder.parent.name}", "run.devices=1", f"seed={seed}")
    config, settings = sweep.make_config(params, *run), sweep.file.objective
    race = sweep.make_config(params, *run, *sweep.conditions) if settings.plant is None else config
    track, laps = make_params(config).track, config.evaluate
    limit = time_limit(track, race_length(track, laps.laps, laps.gates))

    def should_stop_training(row: dict[str, float]) -> bool:
        lap_time = min(row.get("best_lap_total", limit), limit)
        return stop_when(row["steps"] / config.run.steps, lap_time)

    try:
        if not train(config, folder, resume=True, stop_when=should_stop_training).finished:
            return None
    except NonFiniteError:
        return limit, 0.0
    result = evaluate(
        folder / ("policy.npz" if settings.policy == "best" else "policy_last.npz"),
        race,
        plant=settings.plant,
        drones=None if settings.plant is None else settings.drones,
        runs=settings.runs,
        deterministic=settings.deterministic,
        seed=FLIGHT_SEED,
    )
    return result.laps.penalized, result.finished / settings.runs


def objective(
    trial: optuna.Trial, sweep: Sweep, directory: Path, measure: Measure, stop: threading.Event
) -> float:
    """The median of a trial's seeds, s; what was measured becomes its user attributes."""
    folder = directory / "trials" / f"{number_of(trial.study.trials[trial.number]):04d}"
    values: list[float] = []
    finished, started, seeds = 0.0, time.monotonic(), sweep.file.objective.seeds
    last, pruned = 0, False

    def should_stop(fraction: float, lap_time: float) -> bool:
        nonlocal last, pruned
        step = int((len(values) + min(fraction, 1.0)) * REPORTS + 1e-9)
        if step > last and not pruned:
            trial.report(statistics.median([*values, lap_time]), step)
            last, pruned = step, trial.should_prune()
        return pruned or stop.is_set()

    try:
        params = sweep.suggest(trial)
        for seed in range(seeds):
            result = measure(sweep, params, seed, folder / f"seed{seed}", should_stop)
            if result is None:
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
    if len(values) < seeds:
        raise TrialStopped
    return statistics.median(values)


def training(study: optuna.Study, sweep: Sweep) -> str:
    """How far the running trials are, by their last reports."""
    whole = REPORTS * sweep.file.objective.seeds
    trials = study.get_trials(deepcopy=False, states=(State.RUNNING,))
    parts = [f"trial {number_of(t)} {100.0 * (t.last_step or 0) / whole:.0f}%" for t in trials]
    return f"training: {', '.join(parts)}" if parts else "starting the workers"


def work(sweep: Sweep, directory: Path, measure: Measure, end: float, slot: int, name: str) -> None:
    """Run trials, one after another.

    Args:
        sweep: the sweep.
        directory: of its results.
        measure: runs one seed of a trial.
        end: wall time, s, after which no trial starts.
        slot: number of the worker, which changes the seed of the sampler.
        name: of the worker, for its trials' user attribute ``worker``.
    """
    study = open_study(sweep, directory, slot)
    with interruptions(b"") as stop:

        def run_one(trial: optuna.Trial) -> float:
            if is_beyond(study, trial.number, sweep.trials):
                trial.set_user_attr(BEYOND, True)
                raise TrialStopped
            trial.set_user_attr("worker", name)
            try:
                return objective(trial, sweep, directory, measure, stop)
            except KeyboardInterrupt:  # Optuna would end the trial for good
                stop.set()
                raise TrialStopped from None

        def after(study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
            if trial.state == State.FAIL and not {"error", BEYOND} & set(trial.user_attrs):
                retry(study, trial)

        while not stop.is_set() and time.time() < end and trials_left(study, sweep):
            study.optimize(run_one, n_trials=1, catch=TrialStopped, callbacks=[after])


def run_sweep(
    sweep: Sweep, directory: Path, workers: LocalWorkers | RayWorkers, measure: Measure
) -> bool:
    """Run trials until the budget is used up or the time is over; False after Ctrl-C."""
    seconds, retries = sweep.file.budget.seconds or math.inf, sweep.file.executor.retries
    journal, started = sweep.file.storage == JOURNAL, time.monotonic()
    arguments = (sweep, directory.resolve(), measure, time.time() + seconds)
    if journal:  # which only this command uses
        drop_partial_line(directory)
    study = open_study(sweep, directory)
    if journal:
        retry_running(study)
    first = printed = len(trials_over(study))
    spoken = started
    running: dict[int, tuple[str, Any]] = {}
    stopped: set[str] = set()  # workers, which a second signal would end without saving
    guard = contextlib.nullcontext() if journal else storage_errors(sweep, directory)
    with interruptions() as stop, guard:
        while (over := len(trials_over(study))) < sweep.trials or running:
            elapsed, interrupted = time.monotonic() - started, stop.is_set()
            ends = interrupted or elapsed > seconds
            if over == printed and time.monotonic() - spoken > PRINT_AFTER_S and running:
                spoken, now = time.monotonic(), training(study, sweep)
                print(f"{sweep.file.name}: {now}", file=sys.stderr, flush=True)
            if over != printed:
                spoken = time.monotonic()
                printed, text = over, f"{sweep.file.name}: {progress(study, sweep)}"
                rest = (sweep.trials - over) * elapsed / max(over - first, 1)
                text += f", about {datetime.timedelta(seconds=round(rest))} left" if rest else ""
                print(text, file=sys.stderr, flush=True)
            room = min(workers.count, sweep.trials - over)
            for slot in range(workers.count if trials_left(study, sweep) and not ends else 0):
                if slot not in running and len(running) < room:
                    name = uuid.uuid4().hex
                    running[slot] = name, workers.start(slot, work, *arguments, slot, name)
            for slot, (name, worker) in list(running.items()):
                if interrupted and name not in stopped:
                    stopped.add(name)
                    workers.stop(worker)
                if (reason := workers.reason(worker)) is not None:
                    del running[slot]
                    if reason and not interrupted:
                        print(f"{sweep.file.name}: {reason}", file=sys.stderr, flush=True)
                        retry_running(study, retries, name)
            if ends and not running:
                break
            if not running and journal:
                retry_running(study, retries)
            optuna.storages.fail_stale_trials(study)  # of other machines, in a database
            time.sleep(POLL_S)
    return not stop.is_set()
