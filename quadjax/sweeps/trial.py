"""One trial, as a worker runs it: trainings over seeds, and timed flights of their policies."""

import dataclasses
import math
import socket
import statistics
from collections.abc import Callable
from pathlib import Path

import numpy as np

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.sweeps.schema import Objective

FLIGHT_SEED = 1
NOT_REACHED = 4.0  # value of a target never reached, in training times

# Reports (step, value so far) and returns whether to stop; step -1 only asks.
Tell = Callable[[int, float], bool]


@dataclasses.dataclass(frozen=True)
class Job:
    """A trial to run; pickled to a worker."""

    configs: tuple[Config, ...]  # one for each seed
    race: Config  # in which their policies are evaluated
    folder: Path  # of the trial; a seed's run is in seed0, seed1, ..
    objective: Objective
    reports: int  # to the pruner in each training; 0: none


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a worker returns."""

    values: tuple[float, ...]  # of the finished seeds, s
    finished: float  # share of the flights that finished, 0 to 1
    complete: bool  # False: stopped before the end
    error: str = ""  # why the trial cannot run
    host: str = dataclasses.field(default_factory=socket.gethostname)


def run_trial(job: Job, tell: Tell) -> Outcome:
    """Train and evaluate all seeds of a trial, each from its own checkpoint if there is one."""
    values: list[float] = []
    finished: list[float] = []
    for seed in range(len(job.configs)):
        try:
            found = _run_seed(job, seed, values, tell)
        except InputError as error:
            return Outcome(tuple(values), 0.0, False, str(error))
        if found is None:
            break
        values.append(found[0])
        finished.append(found[1])
    share = statistics.fmean(finished) if finished else 0.0
    return Outcome(tuple(values), share, len(values) == len(job.configs))


def _run_seed(job: Job, seed: int, before: list[float], tell: Tell) -> tuple[float, float] | None:
    """Value and share of finished flights of one seed; None where the training was stopped.

    A training with a number that is not finite counts as no lap flown.
    """
    from quadjax.learners.loop import NonFiniteError
    from quadjax.training.run import train

    config, asked, folder = job.configs[seed], job.objective, job.folder / f"seed{seed}"
    missing = missing_lap(config, asked)
    reached = False

    def enough(row: dict[str, float]) -> bool:
        nonlocal reached
        best = row["best_lap_total"]
        value = best if math.isfinite(best) else missing * config.evaluate.laps
        done = int(min(row["steps"] / config.run.steps, 1.0) * job.reports + 1e-9)
        step = seed * job.reports + done if done else -1
        reached = asked.measure == "seconds_to" and best <= asked.target
        return tell(step, statistics.median([*before, value])) or reached

    try:
        result = train(config, folder, resume=True, enough=enough)
    except NonFiniteError:
        return missing * config.evaluate.laps, 0.0
    if not result.finished and not reached:
        return None
    if asked.measure == "seconds_to":
        return seconds_to(folder, asked.target)
    return lap_time(job, folder, missing)


def missing_lap(config: Config, objective: Objective) -> float:
    """Time that counts for a lap that is not flown, s: longer than any lap that is flown."""
    if objective.missing_lap is not None:
        return objective.missing_lap
    from quadjax.race.build import build_params
    from quadjax.race.laps import time_limit

    return time_limit(build_params(config).track, 1)


def lap_time(job: Job, run: Path, missing: float) -> tuple[float, float]:
    """Mean time of all laps (s) of a run's policy, and the share of its flights that finished."""
    from quadjax.evaluation.evaluation import evaluate

    asked, file = job.objective, {"best": "policy.npz", "last": "policy_last.npz"}
    exact, path = asked.deterministic, run / file[asked.policy]
    flown = evaluate(path, job.race, runs=asked.flights, deterministic=exact, seed=FLIGHT_SEED)
    return total_time(flown.lap_times, missing), flown.finished / asked.flights


def total_time(lap_times: np.ndarray, missing: float) -> float:
    """Mean time of all laps, s, with ``missing`` s for each lap that was not flown.

    Args:
        lap_times: (flights, laps) s, NaN where not flown.
        missing: s.
    """
    return float(np.where(np.isfinite(lap_times), lap_times, missing).sum(axis=1).mean())


def seconds_to(run: Path, target: float) -> tuple[float, float]:
    """Training time (s) until a flight took at most ``target`` s; 1.0 if any flight finished.

    Where none was that fast, the training time of the whole run times ``1 + best / target``, or
    times ``NOT_REACHED`` if no flight finished. Compilation and evaluation do not count.
    """
    from quadjax.training.metrics import read_metrics

    rows = read_metrics(run / "metrics.csv")
    seconds = np.cumsum(np.diff(rows["steps"], prepend=0.0) / rows["steps_per_second"])
    best = float(np.min(rows["lap_total"]))
    under = np.flatnonzero(rows["lap_total"] <= target)
    if under.size:
        return float(seconds[under[0]]), 1.0
    return float(seconds[-1]) * min(NOT_REACHED, 1.0 + best / target), float(math.isfinite(best))
