"""What a trial is judged by: lap times with a penalty for laps that are not flown."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.config.loading import load_config
from quadjax.learners.loop import Row
from quadjax.policy import pilot
from quadjax.policy.file import read_policy
from quadjax.sweeps.schema import ObjectiveConfig
from quadjax.training.metrics import read_metrics

FLIGHT_SEED = 1
NEVER = 4.0  # a target that is not reached, by a policy that does not finish: so many times the run


def lap_time(lap_times: np.ndarray, missing_lap: float) -> float:
    """Mean time of all laps, s, with ``missing_lap`` for each lap that was not flown.

    Args:
        lap_times: (runs, laps) s, NaN where not flown.
        missing_lap: s; larger than any lap that is flown, it is the penalty for a crash.
    """
    return float(np.where(np.isfinite(lap_times), lap_times, missing_lap).sum(axis=1).mean())


def median(values: Sequence[float]) -> float:
    """The median over seeds."""
    return float(np.median(np.asarray(values, np.float64)))


def judge(run: Path, objective: ObjectiveConfig, conditions: Sequence[str]) -> float:
    """The value of one seed's finished run, s; lower is better.

    ``lap_time``: the policy's timed flights from hover. ``seconds_to``: seconds of training alone,
    without compiling and evaluating, until a deterministic flight took at most ``target``.

    Args:
        run: the run's folder.
        objective: what to judge by.
        conditions: ``key=value`` words: the race in which every trial's policy flies.
    """
    if objective.measure == "seconds_to":
        return seconds_to(run, objective.target)
    config = load_config(run / "config.yaml", conditions)
    name = {"best": "policy.npz", "last": "policy_last.npz"}[objective.policy]
    race = pilot.Race(config.evaluate.laps, objective.flights, True, FLIGHT_SEED)
    laps, _ = pilot.fly_policy(config, read_policy(run / name), race, objective.deterministic)
    return lap_time(laps.lap_times, objective.missing_lap)


def seconds_to(run: Path, target: float) -> float:
    """Seconds of training until a flight took at most ``target`` s.

    Where none did: the whole run's seconds, once and again as often as its best flight is longer
    than the target, or four times where no flight finished.
    """
    rows = read_metrics(run / "metrics.csv")
    chunks = np.diff(rows["steps"], prepend=0.0)
    seconds = np.cumsum(chunks / rows["steps_per_second"])
    under = np.flatnonzero(rows["lap_total"] <= target)
    if under.size:
        return float(seconds[under[0]])
    best = float(np.min(rows["lap_total"]))
    return float(seconds[-1]) * min(NEVER, 1.0 + best / target)


def so_far(row: Row, objective: ObjectiveConfig, laps: int) -> float:
    """A run's value while it trains, s: its best flight, or all laps missing."""
    best = row["best_lap_total"]
    return best if math.isfinite(best) else objective.missing_lap * laps
