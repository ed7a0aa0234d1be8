"""CSV files of numbers, row by row. Rows are numbered as in an editor: the first row is row 1."""

import csv
import itertools
import math
import re
from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError, reading
from quadjax.core.files import check_file

MAX_BYTES = 2**30  # of one log: hours of flight
MAX_SETTINGS = 2000  # rows of settings before the header


@dataclass(frozen=True)
class LogTable:
    """Columns of a log in its own units and frames."""

    columns: Mapping[str, np.ndarray]  # (n,) by name
    settings: Mapping[str, str] = field(default_factory=dict)  # of the log's head
    first_row: int | None = None  # row of the first sample in the file; None for no rows
    cut_row: int | None = None  # the last row of the file, left out: no line break ends it

    def where(self, index: int) -> str:
        """A sample's place in the file, for messages."""
        return f"sample {index}" if self.first_row is None else f"row {self.first_row + index}"


def numbers_of(settings: Mapping[str, str], name: str) -> list[float]:
    """The numbers in the value of a setting; none without it."""
    return [float(word) for word in re.findall(r"-?\d+(?:\.\d+)?", settings.get(name, ""))]


def read_csv(
    path: Path | str, select: Callable[[list[str]], list[str]], settings: bool = False
) -> LogTable:
    """Columns of a CSV file.

    Args:
        path: of the file.
        select: names of the columns to read, of those of the header.
        settings: rows of two cells, a setting and its value, precede the header.

    Raises:
        InputError: no such file or column, or a cell that is no finite number.
    """
    head, start = _head(path, settings)
    header = [name.strip() for name in head.pop()]
    names = select(header)
    for name in names:
        if header.count(name) != 1:
            problem = "is missing" if name not in header else "is there twice"
            raise InputError(f"{path}: row {start}, column {name!r} {problem}")
    table, cut_row = _table(path, header, names, start)
    found = {cells[0].strip(): ",".join(cells[1:]).strip() for cells in head if any(cells)}
    return LogTable(dict(zip(names, table.T, strict=True)), found, start + 1, cut_row)


def read_header(path: Path | str, settings: bool = False) -> list[str]:
    """The names of the columns of a CSV file; arguments as of ``read_csv``.

    Raises:
        InputError: not a file, too large, or an empty first row.
    """
    return [name.strip() for name in _head(path, settings)[0][-1]]


def _head(path: Path | str, settings: bool) -> tuple[list[list[str]], int]:
    """The rows of a file up to its header, and the header's number."""
    check_file(path)
    size = Path(path).stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"{path}: {size:,} bytes, allowed: up to {MAX_BYTES:,} for a flight")
    head: list[list[str]] = []
    for row, cells in _rows(path):
        head.append(cells)
        if not settings or len(cells) > 2 or row > MAX_SETTINGS:
            break
    if not head or not any(name.strip() for name in head[-1]):
        last = max(len(head), 1)
        raise InputError(f"{path}: row {last} is empty, expected the names of the columns")
    return head, len(head)


def _rows(path: Path | str) -> Iterator[tuple[int, list[str]]]:
    """Numbered rows of a CSV file, from 1."""
    row = 1
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            for row, cells in enumerate(csv.reader(stream), start=1):
                yield row, cells
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not readable as CSV text from row {row} on ({error})") from None


def _ended_rows(path: Path | str) -> Iterator[tuple[int, list[str], bool]]:
    """As ``_rows``, each with whether a line break ends it, which only the last row may lack."""
    with reading(path), open(path, "rb") as stream:
        stream.seek(-1, 2)
        ended = stream.read(1) in b"\r\n"
    for here, following in itertools.pairwise(itertools.chain(_rows(path), [None])):
        if here is not None:
            yield *here, ended or following is not None


def _table(
    path: Path | str, header: list[str], names: list[str], start: int
) -> tuple[np.ndarray, int | None]:
    """The named columns (n, k) below row ``start`` as float64, finite, and the row that is cut."""
    columns, numbers, empty = [header.index(name) for name in names], array("d"), None
    cut_row = None
    for row, cells, ended in _ended_rows(path):
        if row <= start:
            continue
        if not ended:
            cut_row = row
            continue
        if not any(cells):
            empty = empty or row
            continue
        if empty:
            raise InputError(f"{path}: row {empty}, column {header[0]!r} and on is empty")
        beyond = [cell for cell in cells[len(header) :] if cell.strip()]
        if beyond:
            raise InputError(
                f"{path}: row {row} continues after the last column, {header[-1]!r}, with "
                f"{beyond[0]!r:.80}"
            )
        try:
            values = [float(cells[column]) for column in columns]
        except (IndexError, ValueError):
            values = [math.nan]
        if not math.isfinite(sum(values)):
            _check_cells(path, row, cells, dict(zip(names, columns, strict=True)))
        numbers.extend(values)
    return np.frombuffer(numbers).reshape(-1, len(names)), cut_row


def _check_cells(path: Path | str, row: int, cells: list[str], columns: dict[str, int]) -> None:
    """Refuse the first cell of a row that is not a finite number."""
    for name, column in columns.items():
        where = f"{path}: row {row}, column {name!r}"
        if column >= len(cells):
            raise InputError(f"{where} is missing: the row has {len(cells)} cells")
        try:
            number = float(cells[column])
        except ValueError:
            raise InputError(f"{where} is {cells[column]!r:.80}, expected a number") from None
        if not math.isfinite(number):
            raise InputError(f"{where} is {number}, expected a finite number")
