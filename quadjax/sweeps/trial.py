"""One trial, as a worker runs it: trainings over seeds, and timed flights of their policies."""

import dataclasses
import socket
import statistics
from collections.abc import Callable
from pathlib import Path

from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.sweeps.schema import Objective
from quadjax.sweeps.sweep import Params, Sweep

FLIGHT_SEED = 1

# Reports (step, value so far) and returns whether to stop; step -1 only asks.
Tell = Callable[[int, float], bool]


@dataclasses.dataclass(frozen=True)
class Job:
    """A trial to run."""

    configs: tuple[Config, ...]  # one for each seed
    race: Config  # in which their policies are evaluated
    folder: Path  # of the trial; a seed's run is in seed0, seed1, ..
    objective: Objective
    reports: int  # to the pruner in each training; 0: none


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a trial returns."""

    values: tuple[float, ...]  # of the finished seeds, s
    finished: float  # fraction of the flights that finished
    complete: bool  # False: stopped before the end
    error: str = ""  # why the trial cannot run
    host: str = dataclasses.field(default_factory=socket.gethostname)


def job_of(sweep: Sweep, params: Params, index: int, directory: Path) -> Job:
    """What a trial needs to run; ``InputError`` if its parameters do not go together."""
    own = [f"name=trial{index:04d}", "run.devices=1"]
    seeds = range(sweep.file.objective.seeds)
    return Job(
        configs=tuple(sweep.config_of(params, *own, f"seed={seed}") for seed in seeds),
        race=sweep.config_of(params, *own, *sweep.conditions),
        folder=(directory / "trials" / f"{index:04d}").resolve(),
        objective=sweep.file.objective,
        reports=0 if sweep.file.search.pruner == "none" else sweep.file.search.reports,
    )


def run_trial(job: Job, tell: Tell) -> Outcome:
    """Train and evaluate all seeds of a trial, each from its own checkpoint if there is one."""
    values: tuple[float, ...] = ()
    finished = 0.0  # flights, as a fraction of those of one seed
    for seed in range(len(job.configs)):
        try:
            found = _run_seed(job, seed, values, tell)
        except InputError as error:
            return Outcome(values, 0.0, False, str(error))
        if found is None:
            return Outcome(values, finished / max(seed, 1), False)
        values, finished = (*values, found[0]), finished + found[1]
    return Outcome(values, finished / len(values), True)


def _run_seed(
    job: Job, seed: int, before: tuple[float, ...], tell: Tell
) -> tuple[float, float] | None:
    """Value and fraction of finished flights of one seed; None where the training was stopped."""
    from quadjax.config.race import build_params
    from quadjax.learners.loop import NonFiniteError
    from quadjax.race.laps import race_length, time_limit
    from quadjax.training.run import train

    config, asked, folder = job.configs[seed], job.objective, job.folder / f"seed{seed}"
    track, race = build_params(config).track, config.evaluate
    penalty = time_limit(track, race_length(track, race.laps, race.gates))

    def enough(row: dict[str, float]) -> bool:
        done = int(min(row["steps"] / config.run.steps, 1.0) * job.reports + 1e-9)
        step = seed * job.reports + done if done else -1
        value = min(row["best_lap_total"], penalty)
        return tell(step, statistics.median([*before, value]))

    try:
        run = train(config, folder, resume=True, enough=enough)
    except NonFiniteError:
        return penalty, 0.0
    if not run.finished:
        return None
    policy = folder / ("policy.npz" if asked.policy == "best" else "policy_last.npz")
    return _fly(job, config, policy)


def _fly(job: Job, config: Config, policy: Path) -> tuple[float, float]:
    """Value and fraction of finished flights of a policy file, in the simulator or on the plant."""
    from quadjax.evaluation.evaluation import evaluate

    asked, race = job.objective, job.race if job.objective.plant is None else config
    result = evaluate(
        policy,
        race,
        plant=asked.plant,
        plants=None if asked.plant is None else asked.plants,
        runs=asked.runs,
        deterministic=asked.deterministic,
        seed=FLIGHT_SEED,
    )
    return result.laps.penalized, result.finished / asked.runs
