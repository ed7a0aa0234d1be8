"""Sweep files for tests, and studies without any training."""

from pathlib import Path

import optuna

from quadjax.core.yaml_files import to_yaml
from quadjax.sweeps.run import run_sweep
from quadjax.sweeps.study import State, latest_trials, open_study
from quadjax.sweeps.sweep import load_sweep
from quadjax.sweeps.workers import make_workers

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
    params = {key: sweep.suggest(trial, key) for key in sweep.space}
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
