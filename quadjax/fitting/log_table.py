"""Tables of numbers from CSV files, their times, and their values at other times.

Rows are numbered as in an editor: the first row is row 1.
"""

import csv
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from quadjax.core.contents import TEXT, check_kind
from quadjax.core.errors import InputError, reading, short
from quadjax.core.files import check_file

MAX_BYTES = 2**30  # of one log: hours of flight
MAX_SETTINGS = 2000  # rows of settings before the header
SEPARATORS = {"\t": "tabs", ";": "semicolons", "|": "bars", " ": "spaces"}
INDEX = re.compile(r"\d+(?=\D*$)")  # the last number of a name
FEWEST = 9  # separators in a row of names: of time, rotor speeds or commands, rates and forces


@dataclass(frozen=True)
class LogTable:
    """Columns of a log in its own units and frames."""

    path: str
    columns: Mapping[str, np.ndarray]  # (n,) by name
    settings: Mapping[str, str] = field(default_factory=dict)  # of the log's head
    first_row: int | None = None  # row of the first sample in the file; None for no rows
    left_out: tuple[str, ...] = ()  # what the file has and is not read, as text
    causes: Mapping[int, str] = field(default_factory=dict)  # of gaps, by the sample after them

    def error(self, index: int, columns: str, problem: str) -> InputError:
        """A problem of some columns at a sample, with its place in the file."""
        place = f"sample {index}" if self.first_row is None else f"row {self.first_row + index}"
        return InputError(f"{self.path}: {place}, column {columns}{problem}")


def read_head(path: Path | str, settings: bool = False) -> tuple[list[str], dict[str, str], int]:
    """The names of the columns of a CSV file, the settings above them, and the row of the names.

    Args:
        path: of the file.
        settings: whether rows of two cells, a setting and its value, precede the names.

    Raises:
        InputError: not a text file, too large, or an empty row in place of the names.
    """
    check_file(path)
    size = Path(path).stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"{path}: {size:,} bytes, allowed: up to {MAX_BYTES:,} for a flight")
    check_kind(path, "a table as CSV text", TEXT)
    head: list[list[str]] = []
    with reading(path), open(path, encoding="utf-8-sig") as stream:
        for line in stream:
            _check_separators(path, len(head) + 1, line)
            head.append(_cells(path, line))
            if not settings or len(head[-1]) > 2 or len(head) > MAX_SETTINGS:
                break
    if not head or not any(head[-1]):
        last = max(len(head), 1)
        raise InputError(f"{path}: row {last} is empty, expected the names of the columns")
    values = {cells[0]: ",".join(cells[1:]).strip() for cells in head[:-1] if any(cells)}
    return head[-1], values, len(head)


def _check_separators(path: Path | str, row: int, line: str) -> None:
    """Refuse a row of the head whose columns are separated by something other than commas."""
    for separator, name in SEPARATORS.items():
        if line.strip().count(separator) >= FEWEST and "," not in line:
            raise InputError(
                f"{path}: row {row} has columns separated by {name}, allowed: commas, and numbers "
                "with a decimal point"
            )


def indexed_alike(group: Sequence[str], present: Sequence[str]) -> list[str]:
    """Columns that differ from those of a group by their index: ``motor[4]`` beside ``motor[0]``.

    None where the columns of the group have no index, or differ by more.
    """
    forms = {INDEX.sub("#", name) for name in group}
    if len(forms) != 1 or "#" not in (form := forms.pop()):
        return []
    return [name for name in present if INDEX.sub("#", name) == form and name not in group]


def missing(name: str, present: Sequence[str]) -> str:
    """That a column is missing, with one that differs by case, spaces or a unit, for a message."""

    def plain(text: str) -> str:
        return re.sub(r"\(.*\)|\s", "", text).casefold()

    near = [other for other in present if plain(other) == plain(name)]
    similar = f"; there is {near[0]!r} (logs.columns, logs.units)" if near else ""
    return f"column {name!r} is missing{similar}"


def read_csv(path: Path | str, names: Sequence[str], settings: bool = False) -> LogTable:
    """Columns of a CSV file by name; the last row is left out if no line break ends it.

    ``settings`` as of ``read_head``.

    Raises:
        InputError: no such file or column, an empty row, or a cell that is no number.
    """
    header, header_settings, start = read_head(path, settings)
    for name in names:
        if header.count(name) != 1:
            twice = f"column {name!r} is there twice"
            problem = twice if name in header else missing(name, header)
            raise InputError(f"{path}: row {start}, {problem}")
    places = {name: header.index(name) for name in names}
    row, line, left_out = 0, "", list[str]()

    def whole_lines() -> Iterator[str]:
        nonlocal row, line
        empty = 0
        for row, line in enumerate(stream, 1):
            if row <= start:
                continue
            if not line.endswith("\n"):
                left_out.append(f"row {row}, which may be cut: no line break ends it")
            elif not line.strip():
                empty = empty or row
            elif empty:
                raise InputError(f"{path}: row {empty}, column {header[0]!r} and on is empty")
            else:
                beyond = _cells(path, line)[len(header) :] if line.count(",") >= len(header) else []
                if text := next(filter(None, beyond), ""):
                    raise InputError(
                        f"{path}: row {row} continues after the last column, {header[-1]!r}, with "
                        f"{text!r:.80}"
                    )
                yield line

    with reading(path), open(path, encoding="utf-8-sig") as stream, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a file without a row
        try:
            table = np.loadtxt(
                whole_lines(),
                comments=None,
                delimiter=",",
                quotechar='"',
                usecols=list(places.values()),
                ndmin=2,
            )
        except (InputError, UnicodeDecodeError):
            raise
        except ValueError as error:
            cells = _cells(path, line)
            problem = _fault(cells, places, error)
            if cells == header or set(cells[:1]) & header_settings.keys():
                problem = " begins another log, expected one log in a file: split it there"
            raise InputError(f"{path}: row {row}{problem}") from None
    columns = table.reshape(-1, len(names)).T
    by_name = dict(zip(names, columns, strict=True))
    return LogTable(str(path), by_name, header_settings, start + 1, tuple(left_out))


def _cells(path: Path | str, line: str) -> list[str]:
    """The cells of a row, without spaces."""
    try:
        return [cell.strip() for cell in next(csv.reader([line]), [])]
    except csv.Error as error:
        raise InputError(f"{path}: {line[:40]!r} is no row of CSV text ({error})") from None


def _fault(cells: Sequence[str], places: Mapping[str, int], error: ValueError) -> str:
    """The first cell of a row that is not a number, for a message."""
    for name, place in places.items():
        if place >= len(cells):
            return f", column {name!r} is missing: the row has {len(cells)} cells"
        try:
            np.float64(cells[place])
        except ValueError:
            return f", column {name!r} is {cells[place]!r:.80}, expected a number"
    return f" is not readable as CSV text ({short(str(error), 200, str)})"


def unwrapped(stamps: np.ndarray) -> np.ndarray:
    """Time stamps (n,) in the log's unit without the wraps of a counter of 32 bits."""
    steps = np.diff(stamps, prepend=stamps[:1])
    wraps = (steps < -(2.0**31)) & (steps > -(2.0**32))
    return stamps + 2.0**32 * np.cumsum(wraps)


def time_fault(time: np.ndarray, longest: float) -> tuple[int, str] | None:
    """The first sample of times (n,), s, that do not rise in steps up to ``longest``, and why."""
    steps = np.diff(time)
    bad = np.flatnonzero((steps <= 0.0) | (steps > longest))
    if not len(bad):
        return None if len(steps) else (0, "fewer than two samples")
    row, step = int(bad[0]) + 1, steps[bad[0]]
    if step > 0.0:
        usual = np.median(steps)
        return row, f"a gap of {step:.3g} s among {usual:.3g} s, allowed: {longest:.3g} s"
    word = "runs backwards" if step < 0.0 else "stands still"
    return row, f"time {word}, from {time[row - 1]:.6g} to {time[row]:.6g} s"


def interpolated(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (m, k) at times (m,) from those (n, k) at times (n,)."""
    return np.stack([np.interp(at, time, column) for column in values.T], axis=1)


def continuous(quaternion: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) with the sign that is nearer to that of the previous one."""
    turned = (quaternion[1:] * quaternion[:-1]).sum(axis=1) < 0.0
    signs = np.cumprod(np.where(turned, -1.0, 1.0), axis=0)
    return np.concatenate([quaternion[:1], quaternion[1:] * signs[:, None]])
