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

WAIT_SECONDS = 1.0  # between checks of trials that other machines run


class TrialFailed(Exception):
    """A trial that is queued again, or given up if it has the user attribute ``error``."""


def make_executor(
    sweep: Sweep, directory: Path, function: Function = run_trial
) -> "LocalExecutor | RayExecutor":
    """The executor that the sweep file selects; ``function`` runs a trial there."""
    if sweep.file.executor.kind == "local":
        return LocalExecutor(sweep.file.executor, function, directory / "logs")
    from quadjax.sweeps.cluster import RayExecutor

    return RayExecutor(sweep.file.executor, function)


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
class Running:
    """A trial on an executor, as the objective function of the study."""

    sweep: Sweep
    directory: Path
    executor: "LocalExecutor | RayExecutor"
    stop: threading.Event
    trial: optuna.Trial
    pruned: bool = False
    step: int = -1

    def tell(self, step: int, value: float) -> bool:
        """Report a new step to the pruner; returns whether the trial is to stop."""
        if step > self.step and not self.pruned:
            self.step = step
            self.trial.report(value, step)
            self.pruned = self.trial.should_prune()
        return self.pruned or self.stop.is_set()

    def run(self) -> float:
        """Run the trial and return its value."""
        trial, started = self.trial, time.monotonic()
        if "index" not in trial.user_attrs:  # another machine has emptied the queue meanwhile
            trial.study.stop()
            raise TrialFailed
        try:
            params = {d.key: d.suggest(trial) for d in self.sweep.dimensions}
            job = job_of(self.sweep, params, trial.user_attrs["index"], self.directory)
            outcome = self.executor.run(job, self.tell)
        except InputError as error:
            outcome = Outcome((), 0.0, False, str(error))
        except WorkerDied as error:
            deaths = trial.user_attrs.get("deaths", 0) + (not self.stop.is_set())
            trial.set_user_attr("deaths", deaths)
            given_up = deaths > self.sweep.file.executor.retries
            outcome = Outcome((), 0.0, False, str(error) if given_up else "")
        own = {"values": list(outcome.values), "finished": outcome.finished, "host": outcome.host}
        own["seconds"] = round(time.monotonic() - started, 1)
        for name, value in (own | ({"error": outcome.error} if outcome.error else {})).items():
            trial.set_user_attr(name, value)
        if self.pruned:
            raise optuna.TrialPruned
        if not outcome.complete:
            raise TrialFailed
        return statistics.median(outcome.values)


def run_sweep(
    study: optuna.Study, sweep: Sweep, directory: Path, executor: "LocalExecutor | RayExecutor"
) -> bool:
    """Run the trials of the queue until it is empty or the time is over; False after Ctrl-C."""
    started, before, limit = time.monotonic(), count(study).done, sweep.file.budget.seconds
    journal = sweep.file.storage == "journal"
    guard = contextlib.nullcontext() if journal else storage_errors(sweep, directory)

    def after(study: optuna.Study, trial: optuna.trial.FrozenTrial) -> None:
        own = trial.user_attrs
        if trial.state == State.FAIL and "index" in own and "error" not in own:
            retry(study, trial)
        if stop.is_set():
            study.stop()
        text = progress(count(study), before, time.monotonic() - started)
        print(f"{sweep.file.name}: {text}", file=sys.stderr, flush=True)

    with interruptions() as stop, guard:
        while not stop.is_set() and (counts := count(study)).waiting + counts.running:
            left = None if limit is None else limit - (time.monotonic() - started)
            if left is not None and left <= 0:
                break
            if not counts.waiting:  # other machines run the rest
                stop.wait(WAIT_SECONDS)
                optuna.storages.fail_stale_trials(study)
                continue
            study.optimize(
                lambda trial: Running(sweep, directory, executor, stop, trial).run(),
                n_trials=counts.waiting,
                timeout=left,
                n_jobs=executor.workers,
                catch=(TrialFailed,),
                callbacks=[after],
            )
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
