"""Small sweeps, and trials whose training is a short sleep or nothing.

``python -m tests.sweeps.stand_in FILE RUNS [key=value ...]`` runs a whole sweep of such trials.
"""

import os
import sys
import time
from pathlib import Path

import optuna

from quadjax.core.errors import run_command
from quadjax.core.folders import claim
from quadjax.core.yaml_files import to_yaml
from quadjax.sweeps.run import run_sweep
from quadjax.sweeps.study import State, count, latest_trials, open_study
from quadjax.sweeps.sweep import load_sweep
from quadjax.sweeps.workers import make_workers

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
    directory.mkdir(parents=True, exist_ok=True)
    return sweep, directory, open_study(sweep, directory)


def finish(study: optuna.Study, sweep, value=None, flown: float = 1.0) -> optuna.Trial:
    """Take the next trial of the queue and give it a value."""
    trial = study.ask()
    params = sweep.suggest(trial)
    value = value_of(params[CLIP], params.get(RATE, 0.0)) if value is None else value
    own = {"values": [value], "finished": flown, "seconds": 1.5, "host": "here"}
    for name, item in own.items():
        trial.set_user_attr(name, item)
    study.tell(trial, value)
    return trial


def run_small(sweep, directory: Path, measure) -> bool:
    """Run the small sweep with a stand-in for its trainings."""
    return run_sweep(sweep, directory, make_workers(sweep.file.executor, directory), measure)


def complete(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    """The complete trials in the order of their indexes."""
    found = sorted(latest_trials(study).items())
    return [trial for _, trial in found if trial.state == State.COMPLETE]


def value_of(clip: float, rate: float) -> float:
    """What the stand-in for a training finds."""
    return 10.0 + abs(clip - 0.2) * 50.0 + 100.0 * rate


def measure(sweep, params, index, seed, folder, enough):
    """Resume a counter of ticks in the trial's folder, and stop on request."""
    folder = folder.parent
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "workers", "a") as stream:
        stream.write(f"{os.getpid()}\n")
    ticks = folder / "ticks"
    value = value_of(params[CLIP], params[RATE])
    for tick in range(int(ticks.read_text()) if ticks.exists() else 0, 10):
        time.sleep(SECONDS / 10)
        ticks.write_text(str(tick + 1))
        if enough((tick + 1) / 10, value):
            return None
    with open(folder / "finished", "a") as stream:
        stream.write(f"{os.getpid()}\n")
    return value, 1.0


def sweep(path: str, runs: str, *overrides: str) -> int:
    """A whole sweep without its report."""
    loaded = load_sweep(path, overrides)
    directory = Path(runs) / loaded.file.name
    with claim(directory, "sweep"):
        if not run_small(loaded, directory, stand_in.measure):
            return 130
        return int(count(open_study(loaded, directory, run=False))[State.FAIL] > 0)


if __name__ == "__main__":
    from tests.sweeps import stand_in  # so that workers find ``measure`` by its module

    sys.exit(run_command(lambda: sweep(*sys.argv[1:])))
