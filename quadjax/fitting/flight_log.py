"""Flight logs: reading, checking, and conversion to one set of units and frames.

A file is read as a table, its columns become quantities in SI and rpm, these are brought to body
FRD and world NED and to evenly spaced times, and they are compared with one another.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.files import whole_file
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.consistency import check_consistency
from quadjax.fitting.formats import COMMANDS, QUANTITIES, Quantities, log_format
from quadjax.fitting.log_table import LogTable, read_csv, read_head
from quadjax.fitting.magnitudes import check_attitude, check_columns, check_time
from quadjax.fitting.motor_evidence import typical_speeds
from quadjax.fitting.quantities import (
    called,
    evenly,
    quantities_of,
    to_standard_frames,
    wanted_columns,
)
from quadjax.flights.flight import AXES, MOTORS, RATES, Flight, Signal, motion_signals

STANDIN_LOGS = "standin_logs"
STANDIN_HINT = (
    "; simulate them: quadjax logs standin --policy e2e_nominal --policy indi_shac "
    f"--output runs/{STANDIN_LOGS}"
)
SIGNALS = {  # of a flight: name, unit and labels by the attribute of a log
    "rpm_command": ("command", "rpm", MOTORS),
    "rpm": ("actuators", "rpm", MOTORS),
    "motor_command": ("motor_command", "", MOTORS),
    "rate_command": ("rate_command", "rad/s", RATES),
    "thrust_command": ("thrust_command", "m/s^2", ("thrust",)),
    "specific_force": ("specific_force", "m/s^2", AXES),
    "flying": ("flying", "", ()),
}


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
    cut_row: int | None = None  # the last row of the file, left out because no line break ends it
    unchecked: tuple[str, ...] = ()  # columns without evidence of sign and order
    motor_command: np.ndarray | None = None  # (n, 4) 0 to 1
    speeds_measured: bool = True  # false: ``rpm`` is that of typical motors at the motor commands

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return (len(self.time) - 1) / float(self.time[-1] - self.time[0])

    def flight(self, name: str | None = None) -> Flight:
        """The log as a flight, without gates; not for a log without a position.

        It has further signals, those of ``SIGNALS`` that the log has; "command" and "actuators" are
        propeller speeds. Without an attitude it is NaN, and the velocity is the derivative of the
        position.

        Args:
            name: of the flight; that of the log if not given.
        """
        assert self.position is not None
        if self.attitude is None:
            velocity = np.gradient(self.position, self.time, axis=0)
            attitude = np.full_like(velocity, np.nan)
        else:
            velocity = self.attitude.apply(self.body_velocity)
            attitude = self.attitude.as_euler("ZYX")[:, ::-1]
        motion = {"position": self.position, "velocity": velocity, "attitude": attitude}
        signals = motion_signals(motion | {"rates": self.rates})
        for attribute, (signal, unit, labels) in SIGNALS.items():
            values = getattr(self, attribute)
            if values is not None and (attribute != "rpm" or self.speeds_measured):
                columns = np.asarray(values, np.float64).reshape(len(values), -1)
                signals[signal] = Signal(columns, unit, labels)
        source = {"note": "flight log", "path": self.path}
        return Flight(name or self.name, self.time, signals, source=source)

    def __getitem__(self, rows: slice) -> Self:
        """The flight at some consecutive samples."""
        arrays = {k: v for k, v in vars(self).items() if isinstance(v, (np.ndarray, Rotation))}
        sampled: dict[str, Any] = {name: values[rows] for name, values in arrays.items()}
        return replace(self, **sampled)


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
            hint = STANDIN_HINT if STANDIN_LOGS in Path(pattern).parts else ""
            raise InputError(f"{pattern}: no such file (logs.files){hint}")
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


def read_logs(
    config: LogsConfig, folder: Path, report: Callable[[str], None] = lambda line: None
) -> list[FlightLog]:
    """Read every flight of a config; ``report`` is called with the progress.

    Arguments and errors as ``find_logs`` and ``read_log``.
    """
    logs = []
    for path in find_logs(config, folder):
        report(f"reading {path.name}")
        logs.append(read_log(path, config))
    return logs


def read_log(path: Path | str, config: LogsConfig) -> FlightLog:
    """Read one flight log.

    A last row of a CSV file that no line break ends is left out: its last number may be cut.

    Raises:
        InputError: a missing column, a cell that is no finite number, a time that does not increase
            or has a gap, an implausible unit, a column that contradicts the others, a file that is
            empty or too short; one line with the file, the column and the row.
    """
    form = log_format(config.format)
    if form.read is not None:
        columns = called(form.read, path, Path(path))
        if not isinstance(columns, Mapping):
            raise InputError(f"{path}: the reader gives {columns!r:.40}, expected columns by name")
        return _log(LogTable(str(path), columns), config)
    header = read_head(path, form.settings)[0]
    wanted = wanted_columns(path, config, form, header)
    names = [name for group in wanted.values() for name in group]
    return _log(read_csv(path, names, form.settings), config)


def log_of_columns(columns: Quantities, config: LogsConfig, path: Path | str) -> FlightLog:
    """A flight log from columns (n,) by name, the first sample in row 2 of a file.

    Arguments and errors as ``read_log``; the stem of the path is the name of the log.
    """
    return _log(LogTable(str(path), columns, first_row=2), config)


def _log(table: LogTable, config: LogsConfig) -> FlightLog:
    form, path = log_format(config.format), table.path
    names = wanted_columns(path, config, form, list(table.columns))
    quantities = quantities_of(table, names, config, form)
    check_time(table, names, quantities, config)
    check_attitude(table, names, quantities)
    if form.adjust is not None:
        quantities = called(form.adjust, path, quantities, table.settings)
    check_columns(table, names, quantities, config)
    frames = (config.body_frame or form.body_frame, config.world_frame or form.world_frame)
    standard, frames = to_standard_frames(quantities, *frames)
    if frames[1] == "ENU":  # the names in the order of north, east, down
        world = [name for name in names if QUANTITIES[name].frame == "world"]
        names = names | {name: [names[name][i] for i in (1, 0, 2)] for name in world}
    even, flying = evenly(standard)
    even["acceleration"] = even["acceleration"] - even.pop("acceleration_bias", 0.0)
    rate = (len(flying) - 1) / float(even["time"][-1] - even["time"][0])
    unchecked = check_consistency(path, names, even, rate, flying, frames, config)
    measured = "rpm" in even
    return FlightLog(
        name=Path(path).stem,
        path=path,
        time=even["time"],
        rpm=even["rpm"] if measured else typical_speeds(even["motor_command"], rate),
        speeds_measured=measured,
        **{name: even.get(name) for name in COMMANDS},
        body_velocity=even["body_velocity"],
        rates=even["gyro"],
        specific_force=even["acceleration"],
        flying=flying,
        position=even.get("position"),
        attitude=Rotation.from_quat(even["quaternion"]) if "quaternion" in even else None,
        cut_row=table.cut_row,
        unchecked=tuple(unchecked),
    )


def highest_speed(logs: Sequence[FlightLog]) -> float:
    """The highest speed of some flights, m/s, to 0.1 m/s."""
    speeds = [np.linalg.norm(log.body_velocity[log.flying], axis=1).max() for log in logs]
    return round(float(max(speeds)), 1)


def write_log(path: Path | str, columns: Quantities) -> None:
    """Write columns (n,) as a CSV flight log."""
    with whole_file(path) as temporary:
        table = np.stack(list(columns.values()), axis=1)
        header = ",".join(columns)
        np.savetxt(temporary, table, fmt="%.8g", delimiter=",", header=header, comments="")
