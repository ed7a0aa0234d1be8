"""The metrics of a training run, as CSV and for TensorBoard."""

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.errors import InputError, short, writing
from quadjax.core.files import read_text, write_csv
from quadjax.learners.loop import Row


class MetricsFile:
    """``metrics.csv``: a row per chunk, cut back to the checkpoint when a run is resumed."""

    def __init__(self, directory: Path, steps: int, tensorboard: bool) -> None:
        """Open ``directory/metrics.csv`` after the last row of at most ``steps`` steps."""
        self._path = directory / "metrics.csv"
        self._started = False
        self._rows = [row for row in saved_rows(self._path) if row["steps"] <= steps]
        self._tensorboard = _tensorboard(directory) if tensorboard else None

    def write(self, row: Row) -> None:
        """Add a row."""
        if not self._started:
            write_csv(self._path, [list(row), *(list(each.values()) for each in self._rows)])
            self._started = True
        with (
            writing(self._path),
            open(self._path, "a", newline="", encoding="utf-8") as stream,
        ):
            csv.DictWriter(stream, list(row)).writerow(row)
        if self._tensorboard is not None:
            for name, value in row.items():
                if math.isfinite(value):
                    self._tensorboard.add_scalar(name, value, int(row["steps"]))

    def close(self) -> None:
        """Close TensorBoard's file."""
        if self._tensorboard is not None:
            self._tensorboard.close()


def check_tensorboard() -> None:
    """Raise an ``InputError`` where TensorBoard's files cannot be written."""
    try:
        import tensorboardX  # noqa: F401
    except ImportError:
        raise InputError(
            "run.tensorboard is true, but tensorboardX is not installed: "
            "pip install 'quadjax[tensorboard]'"
        ) from None


def _tensorboard(directory: Path) -> Any:
    check_tensorboard()
    from tensorboardX import SummaryWriter

    return SummaryWriter(str(directory / "tensorboard"))


def saved_rows(path: Path) -> list[Row]:
    """The rows of a ``metrics.csv``; none for a missing file or one that holds no complete row.

    Raises:
        InputError: a damaged file.
    """
    if not path.exists():
        return []
    names, table = _read_table(path)
    rows = [dict(zip(names, numbers, strict=True)) for numbers in table.tolist()]
    try:
        return [row | {"steps": int(row["steps"])} for row in rows]
    except (KeyError, ValueError):
        raise InputError(f"{path}: the column steps is missing or not whole numbers") from None


def read_metrics(path: Path | str) -> dict[str, np.ndarray]:
    """The columns of a metrics CSV, (rows,) each; an empty cell is NaN.

    A truncated last line, which a killed run can leave, is dropped.

    Raises:
        InputError: no such file, no rows, or a cell that is not a number, by line and column.
    """
    names, table = _read_table(path)
    if not len(table):
        raise InputError(f"{path}: holds no rows of metrics")
    return dict(zip(names, table.T, strict=True))


def _read_table(path: Path | str) -> tuple[list[str], np.ndarray]:
    """Names and numbers (rows, columns) of a metrics CSV."""
    text = read_text(path)
    try:
        names, *rows = list(csv.reader(io.StringIO(text, newline=""))) or [[]]
    except csv.Error as error:
        raise InputError(f"{path}: cannot be read ({error})") from error
    if rows and len(rows[-1]) < len(names):
        rows.pop()
    numbers = [_numbers(f"{path} line {line}", names, row) for line, row in enumerate(rows, 2)]
    return names, np.reshape(numbers, (len(rows), len(names)))


def _numbers(where: str, names: list[str], row: list[str]) -> list[float]:
    """The numbers of a row; an empty cell is NaN."""
    if len(row) != len(names):
        raise InputError(f"{where}: {len(row)} cells, expected {len(names)}")
    numbers = []
    for name, cell in zip(names, row, strict=True):
        try:
            numbers.append(float(cell.strip() or "nan"))
        except ValueError:
            raise InputError(
                f"{where}: {short(name)} is {short(cell)}, expected a number"
            ) from None
    return numbers
