"""Flight logs: reading, checking, and conversion to one set of units and frames.

Rows are numbered as in an editor or a spreadsheet: the header is row 1.
"""

import csv
import itertools
import math
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError, reading
from quadjax.core.files import check_file, whole_file
from quadjax.fitting.axis_checks import check_axes
from quadjax.fitting.columns import REQUIRED, scale_of, wanted_columns
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.log_checks import check_angles, check_constant, check_time, check_units
from quadjax.fitting.motor_checks import check_commands, check_motors

Quantities = dict[str, np.ndarray]
MAX_BYTES = 2**30  # of one log: hours of flight
WORLD = ("world_velocity", "position")  # quantities in world axes
FLIP = np.array([1.0, -1.0, -1.0])  # FLU <-> FRD
HALF_TURN = Rotation.from_quat([1.0, 0.0, 0.0, 0.0])  # the same as a rotation
ENU_TO_NED = Rotation.from_matrix([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


@dataclass(frozen=True)
class FlightLog:
    """One flight, n evenly spaced samples; world NED, body FRD."""

    name: str
    path: str
    time: np.ndarray  # (n,) s
    rpm: np.ndarray  # (n, 4) rpm, front-left, front-right, rear-right, rear-left
    rpm_command: np.ndarray | None  # (n, 4) rpm
    rate_command: np.ndarray | None  # (n, 3) rad/s
    thrust_command: np.ndarray | None  # (n,) specific thrust along -z, m/s^2
    body_velocity: np.ndarray  # (n, 3) m/s
    rates: np.ndarray  # (n, 3) rad/s
    specific_force: np.ndarray  # (n, 3) m/s^2, accelerometer less its bias
    flying: np.ndarray  # (n,) bool, from the log's mode; all true without one
    position: np.ndarray | None  # (n, 3) m, world
    attitude: Rotation | None  # n, body to world
    columns: dict[str, list[str]]  # names by quantity
    cut_row: int | None = None  # the last row of the file, left out because no line break ends it
    unchecked: tuple[str, ...] = ()  # columns without evidence of sign and order

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return (len(self.time) - 1) / float(self.time[-1] - self.time[0])


def find_logs(config: LogsConfig, folder: Path) -> list[Path]:
    """Paths of the logs that a config names.

    Args:
        config: with paths or glob patterns.
        folder: relative paths start from the working directory, or else from here.

    Raises:
        InputError: no such file, no file at all, or two flights of one name.
    """
    paths: list[Path] = []
    for pattern in config.files:
        found = _expand(Path(), pattern) or _expand(folder, pattern)
        if not found:
            raise InputError(f"{pattern}: no such file (logs.files)")
        paths += [path for path in found if path not in paths]
    if not paths:
        raise InputError("logs.files is empty, expected at least one flight log")
    names = [path.stem for path in paths]
    doubles = sorted({name for name in names if names.count(name) > 1})
    if doubles:
        raise InputError(f"logs.files: two flights are called {doubles[0]!r}")
    return paths


def _expand(folder: Path, pattern: str) -> list[Path]:
    try:
        whole = folder / Path(pattern).expanduser()
        if whole.is_file() or not pattern:
            return [whole] if pattern else []
        anchor = Path(whole.anchor)
        found = anchor.glob(str(whole.relative_to(anchor)))
        return sorted(path for path in found if path.is_file())
    except (IndexError, RuntimeError, ValueError):  # the root, ~ of no user, or no pattern
        return []


def read_logs(config: LogsConfig, folder: Path) -> list[FlightLog]:
    """Read every flight of a config; arguments and errors as ``find_logs`` and ``read_log``."""
    return [read_log(path, config) for path in find_logs(config, folder)]


def read_log(path: Path | str, config: LogsConfig) -> FlightLog:
    """Read one CSV flight log.

    A last row that no line break ends is left out: its last number may be cut.

    Raises:
        InputError: a missing column, a cell that is no finite number, a time that does not increase
            or has a gap, an implausible unit, a column that contradicts the others, a file that is
            empty or too short; one line with the file, the column and the row.
    """
    header = read_header(path)
    wanted = wanted_columns(config, header)
    _check_wanted(path, wanted, header)
    names = [name for group in wanted.values() for name in group]
    table, cut_row = _table(path, header, names)
    log = log_of_columns(dict(zip(names, table.T, strict=True)), config, path)
    return replace(log, cut_row=cut_row)


def log_of_columns(columns: Quantities, config: LogsConfig, path: Path | str) -> FlightLog:
    """A flight log from columns (n,), finite numbers each, by the names of ``config``.

    Args:
        columns: of a table, in the config's units and frames.
        config: of the columns; ``files`` is not used.
        path: of the table; its stem is the name of the log.

    Raises:
        InputError: as ``read_log``.
    """
    wanted = wanted_columns(config, list(columns))
    _check_wanted(path, wanted, list(columns))
    quantities: Quantities = {}
    for quantity, group in wanted.items():
        values = np.stack([columns[name] for name in group], axis=1)
        values = values * scale_of(quantity, config.units)
        quantities[quantity] = values[:, 0] if len(group) == 1 else values
    check_time(path, wanted["time"][0], quantities["time"], config)
    check_constant(path, wanted, quantities)
    if "euler" in wanted:
        check_angles(path, wanted["euler"], quantities["euler"])
    quantities = _to_standard_frames(path, quantities, config)
    check_units(path, wanted, quantities)
    if config.world_frame == "ENU":  # the names in the order of north, east, down
        ordered = {quantity: wanted[quantity] for quantity in WORLD if quantity in wanted}
        wanted |= {quantity: [names[i] for i in (1, 0, 2)] for quantity, names in ordered.items()}
    log = _assemble(path, quantities, wanted)
    checks = (check_axes, check_motors, check_commands)
    return replace(log, unchecked=tuple(line for check in checks for line in check(log, config)))


def write_log(path: Path | str, columns: Quantities) -> None:
    """Write columns (n,) as a CSV flight log."""
    with whole_file(path) as temporary:
        table = np.stack(list(columns.values()), axis=1)
        header = ",".join(columns)
        np.savetxt(temporary, table, fmt="%.8g", delimiter=",", header=header, comments="")


def _check_wanted(path: Path | str, wanted: dict[str, list[str]], header: list[str]) -> None:
    for quantity in REQUIRED:
        if quantity not in wanted:
            raise InputError(f"{path}: no columns for {quantity} (logs.columns.{quantity})")
    if not {"body_velocity", "world_velocity"} & set(wanted):
        raise InputError(f"{path}: no columns for body_velocity or world_velocity (logs.columns)")
    if "body_velocity" not in wanted and not {"euler", "quaternion"} & set(wanted):
        raise InputError(f"{path}: world_velocity needs euler or quaternion columns (logs.columns)")
    for name in (name for group in wanted.values() for name in group):
        if header.count(name) != 1:
            problem = "is missing" if name not in header else "is there twice"
            raise InputError(f"{path}: row 1, column {name!r} {problem}")


def _rows(path: Path | str) -> Iterator[tuple[int, list[str]]]:
    """Numbered rows of a CSV file, from 1."""
    row = 1
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            for row, cells in enumerate(csv.reader(stream), start=1):
                yield row, cells
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not readable as CSV text from row {row} on ({error})") from None


def read_header(path: Path | str) -> list[str]:
    """The names of the columns of a CSV file.

    Raises:
        InputError: not a file, too large, or an empty first row.
    """
    check_file(path)
    size = Path(path).stat().st_size
    if size > MAX_BYTES:
        raise InputError(f"{path}: {size:,} bytes, allowed: up to {MAX_BYTES:,} for a flight")
    _, header = next(_rows(path), (1, []))
    header = [name.strip() for name in header]
    if not any(header):
        raise InputError(f"{path}: row 1 is empty, expected the names of the columns")
    return header


def _ended_rows(path: Path | str) -> Iterator[tuple[int, list[str], bool]]:
    """As ``_rows``, each with whether a line break ends it, which only the last row may lack."""
    with reading(path), open(path, "rb") as stream:
        stream.seek(-1, 2)
        ended = stream.read(1) in b"\r\n"
    for here, following in itertools.pairwise(itertools.chain(_rows(path), [None])):
        if here is not None:
            yield *here, ended or following is not None


def _table(path: Path | str, header: list[str], names: list[str]) -> tuple[np.ndarray, int | None]:
    """The named columns (n, k) as float64, every one a finite number, and the row that is cut."""
    columns, numbers, empty = [header.index(name) for name in names], array("d"), None
    cut_row = None
    for row, cells, ended in _ended_rows(path):
        if not ended and row > 1:
            cut_row = row
            continue
        if row == 1 or not any(cells):
            empty = empty or (row if row > 1 else None)
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


def _to_standard_frames(path: Path | str, given: Quantities, config: LogsConfig) -> Quantities:
    """Vectors in body FRD and world NED, with body velocity; attitudes as quaternions."""
    result, flu = dict(given), config.body_frame == "FLU"
    if flu:
        for name in ("gyro", "rate_command", "acceleration", "acceleration_bias", "body_velocity"):
            if name in result:
                result[name] = result[name] * FLIP
    if "quaternion" in result:
        try:
            rotation = Rotation.from_quat(result["quaternion"][:, [1, 2, 3, 0]])
        except ValueError:
            raise InputError(f"{path}: a quaternion of length zero") from None
    elif "euler" in result:
        rotation = rotation_of_euler(result["euler"])
    else:
        return result
    if flu:
        rotation = rotation * HALF_TURN
    if config.world_frame == "ENU":
        rotation = ENU_TO_NED * rotation
        for name in WORLD:
            if name in result:
                result[name] = ENU_TO_NED.apply(result[name])
    attitude = rotation.as_quat()  # scalar last
    # Of the two quaternions of an attitude, the one nearer to that of the previous sample.
    nearer = np.sign((attitude[1:] * attitude[:-1]).sum(axis=1))
    attitude[1:] *= np.cumprod(np.where(nearer < 0.0, -1.0, 1.0))[:, None]
    result["quaternion"] = attitude
    if "body_velocity" not in result:
        result["body_velocity"] = rotation.inv().apply(result["world_velocity"])
    return result


def rotation_of_euler(euler: np.ndarray) -> Rotation:
    """Body-to-world rotations ``Rz(psi) Ry(theta) Rx(phi)`` of angles (n, 3), rad."""
    return Rotation.from_euler("ZYX", euler[:, ::-1])


def _assemble(path: Path | str, quantities: Quantities, columns: dict[str, list[str]]) -> FlightLog:
    """Resample to even spacing and build the log."""
    time = quantities["time"]
    steps = np.diff(time)
    count = len(time)
    if np.ptp(steps) > 0.01 * np.median(steps):
        count = int(round((time[-1] - time[0]) / np.median(steps))) + 1
    even = np.linspace(time[0], time[-1], count)

    def resample(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(even, time, column) for column in values.T], axis=1)

    bias = quantities.get("acceleration_bias", 0.0)
    mode = quantities.get("mode")
    position, attitude = quantities.get("position"), quantities.get("quaternion")
    nearest = np.clip(np.searchsorted(time, even - 0.5 * np.median(steps)), 0, len(time) - 1)
    commands = {
        name: quantities[name][nearest] if name in quantities else None
        for name in ("rpm_command", "rate_command", "thrust_command")
    }
    return FlightLog(
        name=Path(path).stem,
        path=str(path),
        time=even,
        rpm=resample(quantities["rpm"]),
        **commands,
        body_velocity=resample(quantities["body_velocity"]),
        rates=resample(quantities["gyro"]),
        specific_force=resample(quantities["acceleration"] - bias),
        flying=np.ones(len(even), bool) if mode is None else mode[nearest] > 0,
        position=None if position is None else resample(position),
        attitude=None if attitude is None else Rotation.from_quat(resample(attitude)),
        columns=columns,
    )
