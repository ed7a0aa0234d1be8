"""Sweep files for tests, and studies without any training."""

from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
TINY = {
    "train": {"drones": 16, "steps": 512, "evaluate_every": 128},
    "network.hidden": [8],
    "ppo": {"steps_per_update": 8, "batches": 2, "epochs": 1},
    "evaluate.laps": 1,
}


def sweep_file(folder: Path, **entries: object) -> Path:
    """A small sweep of PPO's rate and clip, with changes."""
    tree = {
        "name": "small",
        "config": str(ROOT / "configs" / "e2e_ppo.yaml"),
        "overrides": TINY,
        "space": {
            "ppo.learning_rate": {"log": [1e-4, 1e-2]},
            "ppo.clip": {"range": [0.1, 0.3]},
        },
        "search": {"method": "random"},
        "objective": {"seeds": 1, "flights": 2},
        "budget": {"trials": 4},
    }
    path = folder / "small.yaml"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_text(yaml.safe_dump({**tree, **entries}, sort_keys=False))
    return path


def open_store(folder: Path, *words: str, **entries: object):
    """A store of the small sweep in ``folder``."""
    from quadjax.sweeps.schema import load_sweep
    from quadjax.sweeps.store import Store

    sweep = load_sweep(sweep_file(folder, **entries), words)
    return Store(sweep, folder / "runs" / sweep.file.name)


def value_of(params: dict) -> float:
    """What the stand-in for a training finds."""
    return 10.0 + abs(params["ppo.clip"] - 0.2) * 50.0 + 100.0 * params["ppo.learning_rate"]
