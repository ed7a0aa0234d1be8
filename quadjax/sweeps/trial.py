"""One trial, as a worker runs it: trainings over seeds, and timed flights of their policies."""

import dataclasses
import socket
import statistics
from collections.abc import Callable
from pathlib import Path

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.sweeps.schema import Objective

FLIGHT_SEED = 1
NOT_REACHED = 4.0  # factor on the training time of a run in which no flight finished

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
    finished: float  # fraction of the flights that finished
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
    fraction = statistics.fmean(finished) if finished else 0.0
    return Outcome(tuple(values), fraction, len(values) == len(job.configs))


def _run_seed(job: Job, seed: int, before: list[float], tell: Tell) -> tuple[float, float] | None:
    """Value and fraction of finished flights of one seed; None where the training was stopped."""
    from quadjax.config.race import build_params
    from quadjax.evaluation.evaluation import evaluate
    from quadjax.learners.loop import NonFiniteError
    from quadjax.race.laps import time_limit
    from quadjax.training.run import train

    config, asked, folder = job.configs[seed], job.objective, job.folder / f"seed{seed}"
    penalty = time_limit(build_params(config).track, config.evaluate.laps)
    reached = False

    def enough(row: dict[str, float]) -> bool:
        nonlocal reached
        done = int(min(row["steps"] / config.run.steps, 1.0) * job.reports + 1e-9)
        step = seed * job.reports + done if done else -1
        reached = asked.measure == "seconds_to" and row["best_lap_total"] <= asked.target
        value = min(row["best_lap_total"], penalty)
        return tell(step, statistics.median([*before, value])) or reached

    try:
        run = train(config, folder, resume=True, enough=enough)
    except NonFiniteError:
        return penalty, 0.0
    if not run.finished and not reached:
        return None
    if asked.measure == "seconds_to":
        best = run.summary["best_lap_total"]
        late = NOT_REACHED if best is None else min(NOT_REACHED, 1.0 + best / asked.target)
        factor = 1.0 if best is not None and best <= asked.target else late
        return factor * run.seconds_to(asked.target), float(best is not None)
    policy = folder / ("policy.npz" if asked.policy == "best" else "policy_last.npz")
    exact = asked.deterministic
    result = evaluate(policy, job.race, runs=asked.flights, deterministic=exact, seed=FLIGHT_SEED)
    return result.laps.penalized, result.finished / asked.flights
