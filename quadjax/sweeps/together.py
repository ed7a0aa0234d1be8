"""Trials in one program: seeds and float hyperparameters vmapped, a group for each shape."""

import dataclasses
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.learners.loop import NonFiniteError, Row
from quadjax.sweeps import objective
from quadjax.sweeps.store import Claim, Store
from quadjax.sweeps.trial import conclude, prepare_folder
from quadjax.training.many import shape_of, train_many


@dataclasses.dataclass(frozen=True)
class Job:
    """One seed of one trial."""

    claim: Claim
    seed: int
    config: Config
    folder: Path


def run_trials(
    store: Store, claims: Sequence[Claim], lanes: int, stopped: Callable[[], bool]
) -> bool:
    """Train and judge claimed trials together, and tell the store what came of them.

    Args:
        store: the sweep's.
        claims: what to run.
        lanes: at most so many runs in one program.
        stopped: whether this worker was asked to stop; trials then go back to the queue.

    Returns:
        Whether to go on; false where the trials were interrupted.
    """
    began, asked = time.monotonic(), store.sweep.file.objective
    values: dict[int, list[float]] = {claim.trial_id: [] for claim in claims}
    pruned: set[int] = set()
    for group in _groups(_jobs(store, claims), lanes):
        found = _train(store, group, pruned, stopped)
        if found is None:
            for claim in claims:
                store.hand_back(claim)
            return False
        for job, value in zip(group, found, strict=True):
            values[job.claim.trial_id].append(value)
    for claim in claims:
        own = values[claim.trial_id]
        if len(own) == asked.seeds:  # else it has failed already
            conclude(store, claim, own, claim.trial_id in pruned, time.monotonic() - began)
    return True


def _jobs(store: Store, claims: Sequence[Claim]) -> list[Job]:
    """Every seed of every trial whose parameters go together."""
    jobs = []
    for claim in claims:
        folder = prepare_folder(store, claim)
        try:
            for seed in range(store.sweep.file.objective.seeds):
                config = store.sweep.config_of(claim.params, f"trial{claim.slot:04d}", seed)
                jobs.append(Job(claim, seed, config, folder / f"seed{seed}"))
        except InputError as error:
            store.fail(claim, str(error))
    return jobs


def _groups(jobs: Sequence[Job], lanes: int) -> list[list[Job]]:
    """Jobs of one shape, at most ``lanes`` at once."""
    shapes: dict[tuple, list[Job]] = {}
    for job in jobs:
        shapes.setdefault(shape_of(job.config), []).append(job)
    return [
        group[first : first + lanes]
        for group in shapes.values()
        for first in range(0, len(group), lanes)
    ]


def _train(
    store: Store, group: Sequence[Job], pruned: set[int], stopped: Callable[[], bool]
) -> list[float] | None:
    """The value of each run; None where the worker was stopped."""
    asked = store.sweep.file.objective
    marks = {"last": 0}

    def enough(rows: list[Row]) -> bool:
        if asked.measure == "seconds_to":
            return all(row["best_lap_total"] <= asked.target for row in rows)
        return store.sweep.file.search.pruner != "none" and _ask(store, group, rows, marks, pruned)

    for job in group:
        shutil.rmtree(job.folder, ignore_errors=True)
    results = train_many(
        [job.config for job in group], [job.folder for job in group], enough, stopped
    )
    if results is None:
        return None
    worst = asked.missing_lap * group[0].config.evaluate.laps
    return [
        worst
        if isinstance(result, NonFiniteError)
        else objective.judge(job.folder, asked, store.sweep.conditions)
        for job, result in zip(group, results, strict=True)
    ]


def _ask(
    store: Store,
    group: Sequence[Job],
    rows: Sequence[Row],
    marks: dict[str, int],
    pruned: set[int],
) -> bool:
    """Report the median of each trial whose seeds are all here; true once all are pruned."""
    asked, reports = store.sweep.file.objective, store.sweep.file.search.reports
    config = group[0].config
    mark = int(min(1.0, rows[0]["steps"] / config.train.steps) * reports + 1e-9)
    claims = {job.claim.trial_id: job.claim for job in group}
    if mark > marks["last"]:
        marks["last"] = mark
        for trial_id, claim in claims.items():
            own = [
                objective.so_far(row, asked, config.evaluate.laps)
                for job, row in zip(group, rows, strict=True)
                if job.claim.trial_id == trial_id
            ]
            if len(own) < asked.seeds or trial_id in pruned:
                continue
            claim.trial.report(objective.median(own), (asked.seeds - 1) * reports + mark)
            if claim.trial.should_prune():
                pruned.add(trial_id)
    return set(claims) <= pruned
