"""A small sweep, whose trainings are a short sleep or nothing.

``python -m tests.sweeps.stand_in FILE RUNS [key=value ...]`` is ``quadjax sweep`` without its
trainings and figures.
"""

import os
import sys
import time
from pathlib import Path

import optuna

from quadjax import cli
from quadjax.core.errors import InputError
from quadjax.core.yaml_files import to_yaml
from quadjax.sweeps import run
from quadjax.sweeps.study import open_study, trials_over
from quadjax.sweeps.sweep import Sweep, load_sweep
from quadjax.sweeps.workers import LocalWorkers, RayWorkers

SECONDS = float(os.environ.get("STAND_IN_SECONDS", "0.2"))
ROOT = Path(__file__).resolve().parents[2]
TINY = {
    "run": {"steps": 512, "evaluate_every": 128},
    "network.hidden": [8],
    "learner": {"num_envs": 16, "rollout_length": 8, "num_minibatches": 2, "num_epochs": 1},
    "evaluate.laps": 1,
}
RATE, CLIP = "learner.learning_rate", "learner.clip_range"


def sweep_file(folder: Path, **entries: object) -> Path:
    """A small sweep of PPO's rate and clip, with changes."""
    tree = {
        "name": "small",
        "config": str(ROOT / "configs" / "e2e_ppo.yaml"),
        "overrides": TINY,
        "space": {RATE: {"log": [1e-4, 1e-2]}, CLIP: {"range": [0.1, 0.3]}},
        "search": {"method": "random"},
        "objective": {"seeds": 1, "runs": 2},
        "budget": {"trials": 4},
    }
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "small.yaml"
    path.write_text(to_yaml({**tree, **entries}))
    return path


def open_small(folder: Path, *overrides: str, **entries: object):
    """The small sweep, its folder and its study."""
    sweep = load_sweep(sweep_file(folder, **entries), overrides)
    directory = folder / "runs" / sweep.file.name
    return sweep, directory, open_study(sweep, directory)


def run_small(sweep: Sweep, directory: Path, measure) -> bool:
    """Run the small sweep with a stand-in for its trainings."""
    executor = sweep.file.executor
    kind = RayWorkers if executor.kind == "ray" else LocalWorkers
    workers = kind(executor) if kind is RayWorkers else kind(executor, directory / "logs")
    return run.run_sweep(sweep, directory, workers, measure)


def complete(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """The complete trials in the order of their numbers."""
    return [t for t in trials_over(study) if t.state == optuna.trial.TrialState.COMPLETE]


def value_of(params) -> float:
    """What the stand-in for a training measures."""
    return 10.0 + abs(params[CLIP] - 0.2) * 50.0 + 100.0 * params[RATE]


def measure(sweep, params, seed, folder, stop_when):
    """Resume a counter of ticks in the trial's folder, and stop on request."""
    folder = folder.parent
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "workers", "a") as stream:
        stream.write(f"{os.getpid()}\n")
    ticks = folder / "ticks"
    for tick in range(int(ticks.read_text()) if ticks.exists() else 0, 10):
        time.sleep(SECONDS / 10)
        ticks.write_text(str(tick + 1))
        if stop_when((tick + 1) / 10, value_of(params)):
            return None
    return value_of(params), 1.0


def nothing(sweep, params, seed, folder, stop_when):
    """No training: every trial has the same value."""
    return 10.0, 1.0


def impossible(sweep, params, seed, folder, stop_when):
    """A training that a config does not allow, where the clip is large."""
    if params[CLIP] > 0.2:
        raise InputError("track: the gates overlap")
    return value_of(params), 1.0


if __name__ == "__main__":
    from quadjax.sweeps import report
    from tests.sweeps import stand_in  # so that workers find ``measure`` by its module

    run.train_and_fly, report.draw = stand_in.measure, lambda *_: None
    sys.exit(cli.run(["sweep", sys.argv[1], "--output", *sys.argv[2:]]))
