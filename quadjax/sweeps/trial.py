"""One trial: a config trained over its seeds by ``quadjax.training.run``, then judged."""

import dataclasses
import shutil
import time
from collections.abc import Callable
from pathlib import Path

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.learners.loop import NonFiniteError, Row
from quadjax.sweeps import objective
from quadjax.sweeps.store import Claim, Store
from quadjax.training.run import train


@dataclasses.dataclass
class Reports:
    """What a trial tells the pruner: its median so far, so many times a seed."""

    store: Store
    claim: Claim
    done: list[float]  # values of the seeds that have finished
    pruned: bool = False
    last: int = -1

    def ask(self, value: float, seeds_before: int, fraction: float) -> bool:
        """Report at the next mark that training has reached; true to prune.

        Args:
            value: of the seed in training, so far.
            seeds_before: that have finished.
            fraction: of this seed's training that is done.
        """
        marks = self.store.sweep.file.search.reports
        step = seeds_before * marks + int(fraction * marks + 1e-9)
        if step <= self.last or fraction * marks < 1.0 - 1e-9:
            return self.pruned
        self.last = step
        self.claim.trial.report(objective.median([*self.done, value]), step)
        self.pruned = self.claim.trial.should_prune()
        return self.pruned


def folder_of(store: Store, slot: int) -> Path:
    """Where a trial's runs go."""
    return store.directory / "trials" / f"{slot:04d}"


def prepare_folder(store: Store, claim: Claim) -> Path:
    """The trial's folder: kept after an interruption, to go on; begun anew after a death."""
    folder = folder_of(store, claim.slot)
    if claim.attempt:
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def run_trial(store: Store, claim: Claim, stopped: Callable[[], bool]) -> bool:
    """Train and judge a claimed trial, and tell the store what came of it.

    Args:
        store: the sweep's.
        claim: what to run.
        stopped: whether this worker was asked to stop; the trial then goes back to the queue.

    Returns:
        Whether to go on; false where the trial was interrupted.
    """
    began, folder = time.monotonic(), prepare_folder(store, claim)
    reports = Reports(store, claim, [])
    try:
        finished = _seeds(store, claim, folder, reports, stopped)
    except InputError as error:
        store.fail(claim, str(error))
        return True
    if not finished:
        store.hand_back(claim)
        return False
    conclude(store, claim, reports.done, reports.pruned, time.monotonic() - began)
    return True


def conclude(store: Store, claim: Claim, values: list[float], pruned: bool, seconds: float) -> None:
    """Keep a trial's values and close it."""
    store.note(claim, "values", values)
    store.note(claim, "seconds", round(seconds, 1))
    store.finish(claim, objective.median(values), pruned)


def _seeds(
    store: Store, claim: Claim, folder: Path, reports: Reports, stopped: Callable[[], bool]
) -> bool:
    """Train the seeds one after the other; false where the worker was stopped."""
    for seed in range(store.sweep.file.objective.seeds):
        if seed and stopped():
            return False
        config = store.sweep.config_of(claim.params, f"trial{claim.slot:04d}", seed)
        value = train_seed(store, config, folder / f"seed{seed}", reports, seed)
        if value is None:
            return False
        reports.done.append(value)
        if reports.pruned:
            return True
    return True


def train_seed(
    store: Store, config: Config, folder: Path, reports: Reports, seed: int
) -> float | None:
    """Train one seed and judge it; None where it was interrupted.

    A training that meets a number that is not finite counts as no lap flown.
    """
    asked = store.sweep.file.objective
    pruning = store.sweep.file.search.pruner != "none"
    ended: list[float] = []

    def enough(row: Row) -> bool:
        value = objective.so_far(row, asked, config.evaluate.laps)
        if asked.measure == "seconds_to":
            reached = row["best_lap_total"] <= asked.target
        else:
            fraction = row["steps"] / config.train.steps
            reached = pruning and reports.ask(value, seed, min(fraction, 1.0))
        if reached:
            ended.append(value)
        return reached

    try:
        result = train(config, folder, resume=True, enough=enough)
    except NonFiniteError:
        return asked.missing_lap * config.evaluate.laps
    if reports.pruned:
        return ended[-1]
    if not result.finished and not ended:
        return None
    return objective.judge(folder, asked, store.sweep.conditions)
