"""The state of a training run, as its page shows it: from the files of its folder, read-only."""

import contextlib
import math
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import read_json
from quadjax.training.metrics import read_metrics
from quadjax.training.paper import published_total

POINTS = 600  # of a curve


class TrainingRun:
    """A run's folder, which may not exist yet."""

    kind = "training"

    def __init__(self, folder: Path, race: Config | None = None) -> None:
        """Read nothing yet.

        Args:
            folder: of the run.
            race: its config; None for ``config.yaml`` of the folder, which may not name code.
        """
        self._folder, self._race = folder, race

    @property
    def name(self) -> str:
        """The folder's name."""
        return self._folder.resolve().name

    @property
    def policy(self) -> Path:
        """The newest policy's file."""
        return self._folder / "policy_last.npz"

    @property
    def finished(self) -> bool:
        """Whether all steps are trained."""
        return bool(self._summary().get("finished"))

    def _summary(self) -> dict[str, Any]:
        with contextlib.suppress(InputError):
            return read_json(self._folder / "summary.json")
        return {}

    def state(self) -> dict[str, Any]:
        """Curves and progress, as JSON takes them."""
        state: dict[str, Any] = {"finished": self.finished, "total_steps": None}
        with contextlib.suppress(InputError):
            config = self._race or load_config(self._folder / "config.yaml", code=())
            state["total_steps"] = config.run.steps
            state["subtitle"] = f"{config.learner.algorithm}, {config.track.name}"
            state["laps"] = config.evaluate.laps
            published = published_total(config)
            state["reference"] = published and {"label": published[0], "value": published[1]}
        with contextlib.suppress(InputError):
            state["columns"] = curves(read_metrics(self._folder / "metrics.csv"))
        return state


def curves(metrics: dict[str, np.ndarray]) -> dict[str, list[float | None]]:
    """The columns of metrics, at most ``POINTS`` rows of them; not finite is null."""
    count = len(next(iter(metrics.values())))
    rows = np.unique(np.linspace(0, count - 1, min(count, POINTS)).round().astype(int))
    return {
        name: [float(f"{x:.6g}") if math.isfinite(x) else None for x in column[rows]]
        for name, column in metrics.items()
    }
