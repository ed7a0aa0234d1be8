"""The result of a training run: its policy, its metrics and its folder."""

import dataclasses
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import read_json, write_json
from quadjax.core.provenance import provenance
from quadjax.policy.file import Policy
from quadjax.training.checkpoint import Position
from quadjax.training.metrics import read_metrics, saved_rows

NUMBER, OPTIONAL_NUMBER = int | float, int | float | None
SUMMARY = {  # keys of summary.json and the types of their values
    "name": str,
    "seed": int,
    "finished": bool,
    "steps": int,
    "devices": int,
    "seconds": NUMBER,
    "best_lap_total": OPTIONAL_NUMBER,
    "best_steps": OPTIONAL_NUMBER,
    "last_lap_total": OPTIONAL_NUMBER,
    "peak_memory_mib": OPTIONAL_NUMBER,
}


@dataclasses.dataclass(frozen=True)
class Run:
    """A training run.

    Attributes:
        config: what was trained.
        folder: with ``config.yaml``, ``metrics.csv``, ``checkpoints/``, ``policy.npz``,
            ``policy_last.npz`` and ``summary.json``.
        policy: the best one by lap time.
        finished: whether all steps were trained; False after an interruption.
        summary: what ``summary.json`` holds: steps, seconds, lap times in s, memory in MiB.
    """

    config: Config
    folder: Path
    policy: Policy
    finished: bool
    summary: dict[str, Any]

    @property
    def metrics(self) -> dict[str, np.ndarray]:
        """The columns of ``metrics.csv`` by name, one entry for each evaluation during training.

        Raises:
            InputError: the file is missing or damaged.
        """
        return read_metrics(self.folder / "metrics.csv")

    @classmethod
    def load(cls, folder: Path | str, config: Config | Path | str | None = None) -> "Run":
        """The run of a folder.

        Args:
            folder: of the run.
            config: of the run; None for ``config.yaml`` of the folder, which may not name code.

        Raises:
            InputError: a missing or damaged file.
        """
        folder = Path(folder)
        if config is None:
            config = load_config(folder / "config.yaml", code=())
        elif not isinstance(config, Config):
            config = load_config(config)
        summary = read_summary(folder)
        policy = Policy.load(folder / "policy.npz")
        return cls(config, folder, policy, summary["finished"], summary)


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary of a run's folder.

    Raises:
        InputError: missing or damaged.
    """
    path = folder / "summary.json"
    summary = read_json(path)
    wrong = [key for key, kind in SUMMARY.items() if not isinstance(summary.get(key, ...), kind)]
    if wrong:
        raise InputError(f"{path}: damaged ({', '.join(wrong)}); remove it and resume the run")
    return summary


def is_finished(folder: Path) -> bool:
    """Whether a folder holds a run that has trained all its steps."""
    return (folder / "summary.json").exists() and read_summary(folder)["finished"]


def write_summary(
    config: Config, folder: Path, position: Position, devices: int, finished: bool
) -> None:
    """Write ``summary.json``.

    Args:
        config: of the run.
        folder: of the run.
        position: of the training.
        devices: number of them.
        finished: whether all steps were trained.
    """
    rows = saved_rows(folder / "metrics.csv")
    summary = {
        "name": config.name,
        "seed": config.seed,
        "finished": finished,
        "steps": position.steps,
        "devices": devices,
        "seconds": round(position.seconds, 1),
        "best_lap_total": _number(position.best_score),
        "best_steps": position.best_steps,
        "last_lap_total": _number(rows[-1]["lap_total"] if rows else math.inf),
        "peak_memory_mib": peak_memory_mib(),
        "provenance": provenance(config, folder / "policy.npz"),
    }
    write_json(folder / "summary.json", summary)


def _number(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None


def peak_memory_mib() -> float | None:
    """Largest resident memory of this process so far, MiB; None where it is not reported."""
    try:
        import resource
    except ImportError:  # Windows
        peak = getattr(psutil.Process().memory_info(), "peak_wset", None)
        return None if peak is None else round(peak / 2**20, 0)
    unit = 2**20 if sys.platform == "darwin" else 2**10  # of ru_maxrss, in one MiB
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit, 0)
