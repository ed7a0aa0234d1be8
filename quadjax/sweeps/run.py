"""Running a sweep: Optuna's loop over the queue, with each trial on an executor."""

import contextlib
import dataclasses
import datetime
import statistics
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING

from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions
from quadjax.sweeps.extra import optuna
from quadjax.sweeps.local import Function, LocalExecutor, WorkerDied
from quadjax.sweeps.study import Counts, State, count, retry, storage_errors
from quadjax.sweeps.sweep import Params, Sweep
from quadjax.sweeps.trial import Job, Outcome, run_trial

if TYPE_CHECKING:
    from quadjax.sweeps.cluster import RayExecutor

WAIT_SECONDS = 1.0  # between looks at trials that other machines run


class TrialFailed(Exception):
    """A trial that is queued again, or given up if it has the user attribute ``error``."""


def make_executor(
    sweep: Sweep, directory: Path, function: Function = run_trial
) -> "LocalExecutor | RayExecutor":
    """The executor that the sweep file asks for; ``function`` runs a trial there."""
    asked = sweep.file.executor
    if asked.kind == "local":
        return LocalExecutor(asked, function, directory / "logs")
    from quadjax.sweeps.cluster import RayExecutor

    return RayExecutor(asked, function)


def job_of(sweep: Sweep, params: Params, index: int, directory: Path) -> Job:
    """What a worker needs to run a trial; ``InputError`` if the parameters do not go together."""
    own = [f"name=trial{index:04d}", "run.devices=1"]
    seeds = range(sweep.file.objective.seeds)
    return Job(
        configs=tuple(sweep.config_of(params, *own, f"seed={seed}") for seed in seeds),
        race=sweep.config_of(params, *own, *sweep.conditions),
        folder=(directory / "trials" / f"{index:04d}").resolve(),
        objective=sweep.file.objective,
        reports=0 if sweep.file.search.pruner == "none" else sweep.file.search.reports,
    )


@dataclasses.dataclass
class Reports:
    """What a running trial tells the pruner."""

    trial: optuna.Trial
    stop: threading.Event
    pruned: bool = False
    last: int = -1

    def tell(self, step: int, value: float) -> bool:
        """Report a new step; returns whether the trial is to stop."""
        if step > self.last and not self.pruned:
            self.last = step
            self.trial.report(value, step)
            self.pruned = self.trial.should_prune()
        return self.pruned or self.stop.is_set()


@dataclasses.dataclass
class Trials:
    """The objective function of the study, and its callback."""

    sweep: Sweep
    directory: Path
    executor: "LocalExecutor | RayExecutor"
    stop: threading.Event

    def objective(self, trial: optuna.Trial) -> float:
        """Run a trial on the executor and return its value."""
        if "index" not in trial.user_attrs:  # another machine has emptied the queue meanwhile
            trial.study.stop()
            raise TrialFailed
        started, report = time.monotonic(), Reports(trial, self.stop)
        try:
            params = {d.key: d.suggest(trial) for d in self.sweep.dimensions}
            job = job_of(self.sweep, params, trial.user_attrs["index"], self.directory)
            outcome = self.executor.run(job, report.tell)
        except InputError as error:
            outcome = Outcome((), 0.0, False, str(error))
        except WorkerDied as error:
            deaths = trial.user_attrs.get("deaths", 0) + (not self.stop.is_set())
            trial.set_user_attr("deaths", deaths)
            if deaths <= self.sweep.file.executor.retries:
                raise TrialFailed(str(error)) from error
            outcome = Outcome((), 0.0, False, str(error))
        own = {"values": list(outcome.values), "finished": outcome.finished, "host": outcome.host}
        own["seconds"] = round(time.monotonic() - started, 1)
        for name, value in (own | ({"error": outcome.error} if outcome.error else {})).items():
            trial.set_user_attr(name, value)
        if report.pruned:
            raise optuna.TrialPruned
        if outcome.error or not outcome.complete:
            raise TrialFailed(outcome.error or "interrupted")
        return statistics.median(outcome.values)

    def after(self, study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        """Queue an interrupted trial again, and end the loop after Ctrl-C."""
        own = trial.user_attrs
        if trial.state == State.FAIL and "index" in own and "error" not in own:
            retry(study, trial)
        if self.stop.is_set():
            study.stop()


def run_sweep(
    study: optuna.Study, sweep: Sweep, directory: Path, executor: "LocalExecutor | RayExecutor"
) -> bool:
    """Run the trials of the queue until it is empty or the time is over; False after Ctrl-C.

    Raises:
        InputError: the database cannot be used any more.
    """
    started, before, left = time.monotonic(), count(study).done, sweep.file.budget.seconds

    def show(study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        text = progress(count(study), before, time.monotonic() - started)
        print(f"{sweep.file.name}: {text}", file=sys.stderr, flush=True)

    journal = sweep.file.storage == "journal"
    guard = contextlib.nullcontext() if journal else storage_errors(sweep, directory)
    with interruptions() as stop, guard:
        trials = Trials(sweep, directory, executor, stop)
        while not stop.is_set() and (counts := count(study)).waiting + counts.running:
            if sweep.file.budget.seconds is not None:
                left = sweep.file.budget.seconds - (time.monotonic() - started)
                if left <= 0:
                    break
            if not counts.waiting:  # other machines run the rest
                stop.wait(WAIT_SECONDS)
                optuna.storages.fail_stale_trials(study)
                continue
            study.optimize(
                trials.objective,
                n_trials=counts.waiting,
                timeout=left,
                n_jobs=executor.workers,
                catch=(TrialFailed,),
                callbacks=[trials.after, show],
            )
    return not stop.is_set()


def progress(counts: Counts, before: int, seconds: float) -> str:
    """One line: trials done, the best value, and the time left.

    The pace is that of this command: ``seconds`` since ``before`` trials were done.
    """
    open_trials = counts.running + counts.waiting
    text = f"{counts.done}/{counts.done + counts.failed + open_trials} trials, "
    text += "no flight finished yet" if counts.best is None else f"best {counts.best:.2f} s"
    text += f", {counts.failed} failed" if counts.failed else ""
    if counts.done > before:
        left = datetime.timedelta(seconds=round(seconds / (counts.done - before) * open_trials))
        text += f", about {left} left"
    return text
