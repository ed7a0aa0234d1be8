"""Flight logs: read, checked, and brought to one set of arrays, units and frames.

Rows are numbered as an editor or a spreadsheet shows them: the header is row 1.
"""

import csv
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.columns import REQUIRED, check_logs_config, scale_of, wanted_columns
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.log_checks import check_angles, check_time, check_units


@dataclass(frozen=True)
class FlightLog:
    """One flight, n evenly spaced samples; world NED, body FRD."""

    name: str
    path: str
    time: np.ndarray  # (n,) s
    rpm: np.ndarray  # (n, 4) rpm, front-left, front-right, rear-right, rear-left
    rpm_command: np.ndarray | None  # (n, 4) rpm
    body_velocity: np.ndarray  # (n, 3) m/s
    rates: np.ndarray  # (n, 3) rad/s
    specific_force: np.ndarray  # (n, 3) m/s^2, accelerometer less its bias
    flying: np.ndarray  # (n,) bool: the log's own word for it, all true where it has none

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return (len(self.time) - 1) / float(self.time[-1] - self.time[0])


def read_logs(config: LogsConfig, base: Path) -> list[FlightLog]:
    """Read every flight that the config names.

    Args:
        config: files, columns, units and frames.
        base: the folder that relative paths start from.

    Raises:
        InputError: no such file, or whatever ``read_log`` finds; nothing is returned then.
    """
    check_logs_config(config)
    paths: list[Path] = []
    for pattern in config.files:
        found = _expand(base, pattern)
        if not found:
            raise InputError(f"{pattern}: no such file (logs.files)")
        paths += [path for path in found if path not in paths]
    if not paths:
        raise InputError("logs.files is empty, expected at least one flight log")
    names = [path.stem for path in paths]
    doubles = sorted({name for name in names if names.count(name) > 1})
    if doubles:
        raise InputError(f"logs.files: two flights are called {doubles[0]!r}")
    return [read_log(path, config) for path in paths]


def _expand(base: Path, pattern: str) -> list[Path]:
    whole = base / Path(pattern).expanduser()
    if whole.is_file():
        return [whole]
    if not any(letter in pattern for letter in "*?["):
        return []
    anchor = Path(whole.anchor) if whole.is_absolute() else Path()
    relative = whole.relative_to(whole.anchor) if whole.is_absolute() else whole
    return sorted(path for path in anchor.glob(str(relative)) if path.is_file())


def read_log(path: Path | str, config: LogsConfig) -> FlightLog:
    """Read one CSV flight log.

    Raises:
        InputError: a missing column, text or NaN where a number belongs, a time that stands
            still, runs backwards or has a gap, a unit or a sign that cannot be right, a file that
            is empty or too short; one line with the file, the column and the row.
    """
    check_logs_config(config)
    header = _header(path)
    wanted = wanted_columns(config, header)
    for quantity in REQUIRED:
        if quantity not in wanted:
            raise InputError(f"{path}: no columns for {quantity} (logs.columns.{quantity})")
    if not {"body_velocity", "world_velocity"} & set(wanted):
        raise InputError(f"{path}: no columns for body_velocity or world_velocity (logs.columns)")
    if "body_velocity" not in wanted and not {"euler", "quaternion"} & set(wanted):
        raise InputError(f"{path}: world_velocity needs euler or quaternion columns (logs.columns)")
    names = [name for group in wanted.values() for name in group]
    for name in names:
        if header.count(name) != 1:
            problem = "is missing" if name not in header else "is there twice"
            raise InputError(f"{path}: row 1, column {name!r} {problem}")
    table = _table(path, header, names)
    quantities, start = {}, 0
    for quantity, group in wanted.items():
        values = table[:, start : start + len(group)] * scale_of(quantity, config.units)
        quantities[quantity] = values[:, 0] if len(group) == 1 else values
        start += len(group)
    check_time(path, wanted["time"][0], quantities["time"], config)
    if "euler" in wanted:
        check_angles(path, wanted["euler"], quantities["euler"])
    quantities = _to_standard_frames(quantities, config)
    check_units(path, wanted, quantities)
    return _assemble(path, quantities)


def _header(path: Path | str) -> list[str]:
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            header = next(csv.reader(stream), [])
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: row 1 is not readable CSV text ({error})") from None
    header = [name.strip() for name in header]
    if not any(header):
        raise InputError(f"{path}: row 1 is empty, expected the names of the columns")
    return header


def _table(path: Path | str, header: list[str], names: list[str]) -> np.ndarray:
    """The named columns (n, k) as float64, every one a finite number."""
    _check_rows(path, header)
    columns = [header.index(name) for name in names]
    try:
        # Most files are sound: read them fast, and look for the culprit only where that fails.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # no rows: said below, in a line
            table = np.loadtxt(
                path,
                delimiter=",",
                skiprows=1,
                usecols=columns,
                ndmin=2,
                comments=None,
                quotechar='"',
                encoding="utf-8-sig",
            )
    except (ValueError, UnicodeDecodeError):
        raise _culprit(path, header, names) from None
    if not np.isfinite(table).all():
        raise _culprit(path, header, names)
    return table


def _check_rows(path: Path | str, header: list[str]) -> None:
    """No row may be empty, but at the end, or have more cells than there are columns."""
    empty = None
    with open(path, newline="", encoding="utf-8-sig", errors="replace") as stream:
        for row, cells in enumerate(csv.reader(stream), start=1):
            if not any(cells):
                empty = empty or row
                continue
            if empty:
                raise InputError(f"{path}: row {empty}, column {header[0]!r} and on is empty")
            beyond = [cell for cell in cells[len(header) :] if cell.strip()]
            if beyond:
                raise InputError(
                    f"{path}: row {row} goes on after the last column, {header[-1]!r}, with "
                    f"{beyond[0]!r}"
                )


def _culprit(path: Path | str, header: list[str], names: list[str]) -> InputError:
    """An error that names the first cell that is no finite number."""
    with open(path, newline="", encoding="utf-8-sig", errors="replace") as stream:
        for row, cells in enumerate(csv.reader(stream), start=1):
            if row == 1 or not cells:
                continue
            for name in names:
                index = header.index(name)
                where = f"{path}: row {row}, column {name!r}"
                if index >= len(cells):
                    return InputError(f"{where} is missing: the row has {len(cells)} cells")
                try:
                    number = float(cells[index])
                except ValueError:
                    return InputError(f"{where} is {cells[index]!r}, expected a number")
                if not np.isfinite(number):
                    return InputError(f"{where} is {number}, expected a finite number")
    return InputError(f"{path}: row 2 and after cannot be read as numbers")


def _to_standard_frames(
    quantities: dict[str, np.ndarray], config: LogsConfig
) -> dict[str, np.ndarray]:
    """Bring vectors to body FRD and world NED, and add body velocity and Euler angles."""
    result = dict(quantities)
    flip = np.array([1.0, -1.0, -1.0])  # FLU <-> FRD, and the same turn of quaternion and angles
    if config.body_frame == "FLU":
        for name in ("gyro", "acceleration", "acceleration_bias", "body_velocity"):
            if name in result:
                result[name] = result[name] * flip
    if "quaternion" in result:
        rotation = _rotation_of_quaternion(result["quaternion"])
    elif "euler" in result:
        rotation = rotation_of_euler(result["euler"])
    else:
        return result
    if config.body_frame == "FLU":
        rotation = rotation * flip
    if config.world_frame == "ENU":
        rotation = rotation[:, [1, 0, 2], :] * np.array([1.0, 1.0, -1.0])[:, None]
        if "world_velocity" in result:
            result["world_velocity"] = result["world_velocity"][:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    result["euler"] = _euler_of_rotation(rotation)
    if "body_velocity" not in result:
        result["body_velocity"] = np.einsum("nij,ni->nj", rotation, result["world_velocity"])
    return result


def rotation_of_euler(euler: np.ndarray) -> np.ndarray:
    """``Rz(psi) Ry(theta) Rx(phi)``, (n, 3, 3), of angles (n, 3), rad."""
    (sx, sy, sz), (cx, cy, cz) = np.sin(euler).T, np.cos(euler).T
    rows = [
        [cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx],
        [sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx],
        [-sy, cy * sx, cy * cx],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _rotation_of_quaternion(quaternion: np.ndarray) -> np.ndarray:
    """Body-to-world rotation (n, 3, 3) of quaternions (n, 4), scalar first."""
    length = np.linalg.norm(quaternion, axis=1, keepdims=True)
    w, x, y, z = (quaternion / np.maximum(length, 1e-9)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _euler_of_rotation(rotation: np.ndarray) -> np.ndarray:
    pitch = np.arcsin(np.clip(-rotation[:, 2, 0], -1.0, 1.0))
    roll = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2])
    return np.stack([roll, pitch, np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])], axis=1)


def _assemble(path: Path | str, quantities: dict[str, np.ndarray]) -> FlightLog:
    """Resample to even spacing and build the log."""
    time = quantities["time"]
    steps = np.diff(time)
    even = np.linspace(time[0], time[-1], len(time))
    if steps.max() - steps.min() > 0.01 * np.median(steps):
        count = int(round((time[-1] - time[0]) / np.median(steps))) + 1
        even = np.linspace(time[0], time[-1], count)

    def resample(values: np.ndarray) -> np.ndarray:
        columns = values.reshape(len(time), -1).T
        return np.stack([np.interp(even, time, column) for column in columns], axis=1)

    bias = quantities.get("acceleration_bias", 0.0)
    command, mode = quantities.get("rpm_command"), quantities.get("mode")
    nearest = np.clip(np.searchsorted(time, even - 0.5 * np.median(steps)), 0, len(time) - 1)
    return FlightLog(
        name=Path(path).stem,
        path=str(path),
        time=even,
        rpm=resample(quantities["rpm"]),
        rpm_command=None if command is None else command[nearest],
        body_velocity=resample(quantities["body_velocity"]),
        rates=resample(quantities["gyro"]),
        specific_force=resample(quantities["acceleration"] - bias),
        flying=np.ones(len(even), bool) if mode is None else mode[nearest] > 0,
    )
