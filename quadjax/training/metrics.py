"""The metrics of a training run: ``metrics.csv``, and TensorBoard's events."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_text, write_csv
from quadjax.learners.loop import Row


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
        write_csv(self._path, [list(row), *(list(old.values()) for old in self._rows)])
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
    if not all(float(row.get("steps", "nan")).is_integer() for row in rows):
        raise InputError(f"{path}: the column steps is missing or not whole numbers")
    return [row | {"steps": int(row["steps"])} for row in rows]


def read_metrics(path: Path | str) -> dict[str, np.ndarray]:
    """The columns of a metrics CSV, (rows,) each; an empty cell is NaN.

    A truncated last line is dropped.

    Raises:
        InputError: no such file, no rows, or a cell that is not a number, by its line.
    """
    rows = _read_rows(path)
    if not rows:
        raise InputError(f"{path}: holds no rows of metrics")
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def _read_rows(path: Path | str) -> list[Row]:
    names, *lines = [line.split(",") for line in read_text(path).splitlines()] or [[]]
    if lines and len(lines[-1]) < len(names):
        lines.pop()
    rows: list[Row] = []
    for line, cells in enumerate(lines, 2):
        if len(cells) != len(names):
            raise InputError(f"{path} line {line}: {len(cells)} cells, expected {len(names)}")
        rows.append({})
        for name, cell in zip(names, map(str.strip, cells), strict=True):
            try:
                rows[-1][name] = float(cell or "nan")
            except ValueError:
                raise InputError(
                    f"{path} line {line}: {name!r} is {cell!r}, expected a number"
                ) from None
    return rows
