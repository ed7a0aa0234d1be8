"""The result of a training run: its policy, its metrics and its folder; the files of these."""

import csv
import dataclasses
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadjax.config.loading import load_config
from quadjax.config.schema import SCORE_NAMES, Config
from quadjax.core.errors import InputError
from quadjax.core.files import read_json, read_text, write_csv, write_json
from quadjax.core.provenance import provenance
from quadjax.learners.loop import Row
from quadjax.policy.file import Policy

if TYPE_CHECKING:  # of Orbax, which takes a second to import
    from quadjax.training.checkpoint import RunState

NUMBER, OPTIONAL_NUMBER = int | float, int | float | None
SUMMARY = {  # keys of summary.json, except the scores, and the types of their values
    "name": str,
    "seed": int,
    "finished": bool,
    "steps": int,
    "devices": int,
    "seconds": NUMBER,
    "best_steps": OPTIONAL_NUMBER,
    "peak_memory_mib": OPTIONAL_NUMBER,
}


@dataclasses.dataclass(frozen=True)
class Run:
    """A training run.

    Attributes:
        config: what was trained.
        folder: with ``config.yaml``, ``metrics.csv``, ``checkpoints/``, ``policy.npz``,
            ``policy_last.npz`` and ``summary.json``.
        policy: the best one by ``run.score``.
        finished: whether all steps were trained; False after an interruption.
        summary: what ``summary.json`` holds: steps, seconds, scores, memory in MiB.
    """

    config: Config
    folder: Path
    policy: Policy
    finished: bool
    summary: dict[str, Any]

    def __repr__(self) -> str:
        """Its folder, its best score and its steps; the fields hold more."""
        name = f"best_{self.config.run.score_name}"
        ended = "" if self.finished else ", not finished"
        steps = f"{self.summary['steps']:,} steps{ended}"
        return f"Run({str(self.folder)!r}: {name} {self.summary[name]}, {steps})"

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
        policy = Policy.load(folder / "policy.npz", config)
        return cls(config, folder, policy, summary["finished"], summary)


def read_summary(folder: Path) -> dict[str, Any]:
    """The summary of a run's folder.

    Raises:
        InputError: missing or damaged.
    """
    path = folder / "summary.json"
    try:
        summary = read_json(path)
    except InputError as error:
        remedy = "; if it is damaged, remove it and resume the run" if path.exists() else ""
        raise InputError(f"{error}{remedy}") from None
    score = next((name for name in SCORE_NAMES.values() if f"best_{name}" in summary), "score")
    kinds = SUMMARY | {f"{which}_{score}": OPTIONAL_NUMBER for which in ("best", "last")}
    wrong = [key for key, kind in kinds.items() if not isinstance(summary.get(key, ...), kind)]
    if wrong:
        raise InputError(f"{path}: damaged ({', '.join(wrong)}); remove it and resume the run")
    return summary


def is_finished(folder: Path) -> bool:
    """Whether a folder holds a run that has trained all its steps."""
    return (folder / "summary.json").exists() and read_summary(folder)["finished"]


def write_summary(
    config: Config, folder: Path, run_state: "RunState", devices: int, finished: bool
) -> None:
    """Write ``summary.json`` of a run, ``finished`` if all steps were trained.

    ``run.score`` names the scores: ``best_lap_total`` and ``last_lap_total``, or
    ``best_episode_reward`` and ``last_episode_reward``.
    """
    rows = saved_rows(folder / "metrics.csv")
    score = config.run.score_name
    scores = (rows[-1][name] if rows else math.inf for name in (f"best_{score}", score))
    best, last = (round(x, 3) if math.isfinite(x) else None for x in scores)
    summary = {
        "name": config.name,
        "seed": config.seed,
        "finished": finished,
        "steps": run_state.steps,
        "devices": devices,
        "seconds": round(run_state.seconds, 1),
        f"best_{score}": best,
        "best_steps": run_state.best_steps,
        f"last_{score}": last,
        "peak_memory_mib": peak_memory_mib(),
        "provenance": provenance(config, folder / "policy.npz"),
    }
    write_json(folder / "summary.json", summary)


def peak_memory_mib() -> float | None:
    """Largest resident memory of this process so far, MiB; None where it is not reported."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    unit = 2**20 if sys.platform == "darwin" else 2**10  # of ru_maxrss, in one MiB
    return round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit, 0)


class MetricsFile:
    """The rows of a run's ``metrics.csv``, one for each chunk; written as a whole each time."""

    def __init__(self, folder: Path, steps: int, tensorboard: bool) -> None:
        """Open ``folder/metrics.csv``.

        Keep the rows up to ``steps``, the environment step at which the run resumes.
        """
        self._path = folder / "metrics.csv"
        self._rows = [row for row in saved_rows(self._path) if row["steps"] <= steps]
        self._events: Any = None
        if tensorboard:
            from tensorboardX import SummaryWriter

            self._events = SummaryWriter(str(folder / "tensorboard"))

    def write(self, row: Row) -> None:
        """Add a row."""
        self._rows.append(row)
        names = list(dict.fromkeys(name for each in [row, *self._rows] for name in each))
        write_csv(self._path, [names, *([x.get(name, "") for name in names] for x in self._rows)])
        if self._events is not None:
            for name, value in row.items():
                if math.isfinite(value):
                    self._events.add_scalar(name, value, int(row["steps"]))

    def close(self) -> None:
        """Close TensorBoard's file."""
        if self._events is not None:
            self._events.close()


def check_tensorboard() -> None:
    """Raise an ``InputError`` where TensorBoard's files cannot be written."""
    try:
        import tensorboardX  # noqa: F401
    except ImportError:
        raise InputError(
            "run.tensorboard is true, but tensorboardX is not installed: "
            "pip install 'quadjax[tensorboard]'"
        ) from None


def saved_rows(path: Path) -> list[Row]:
    """The rows of a ``metrics.csv``; none for a missing file or one that holds no complete row.

    Raises:
        InputError: a damaged file.
    """
    rows = _read_rows(path) if path.exists() else []
    if not all(row.get("steps", math.nan).is_integer() for row in rows):
        raise InputError(f"{path}: the column steps is missing or not whole numbers")
    return [row | {"steps": int(row["steps"])} for row in rows]


def read_metrics(path: Path | str) -> dict[str, np.ndarray]:
    """The columns of a metrics CSV, (rows,) each; an empty cell is NaN.

    A last row that is cut off is dropped.

    Raises:
        InputError: no such file, no rows, or a row without a number in each column, by its
            line.
    """
    rows = _read_rows(path)
    if not rows:
        raise InputError(f"{path}: holds no rows of metrics")
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _read_rows(path: Path | str) -> list[Row]:
    lines = read_text(path, empty=True).splitlines()
    reader = csv.DictReader(lines)
    try:
        numbered = [(reader.line_num, row) for row in reader]
    except csv.Error as error:
        raise InputError(f"{path} line {reader.line_num}: {error}") from None
    if numbered and None in numbered[-1][1].values():
        numbered.pop()  # cut off
    rows: list[Row] = []
    for number, row in numbered:
        try:
            if None in row or None in row.values():
                raise ValueError
            rows.append({name: float(cell or "nan") for name, cell in row.items()})
        except ValueError:
            allowed = f"{len(reader.fieldnames or ())} numbers"
            raise InputError(
                f"{path} line {number}: {lines[number - 1]!r:.80}, expected {allowed}"
            ) from None
    return rows
