"""Flight logs: reading, checking, and conversion to one set of units and frames."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.files import whole_file
from quadjax.fitting.columns import ATTITUDES, REQUIRED, scale_of, wanted_columns
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.consistency import check_consistency
from quadjax.fitting.csv_table import LogTable, numbers_of
from quadjax.fitting.log_formats import LogFormat, log_format, resolved, table_of_columns
from quadjax.fitting.log_frames import WORLD, to_standard_frames
from quadjax.fitting.magnitudes import (
    Recording,
    check_attitude,
    check_own_frames,
    check_time,
    check_units,
    check_variation,
)
from quadjax.fitting.motor_evidence import typical_speeds
from quadjax.flights.flight import AXES, MOTORS, RATES, Flight, Signal, motion_signals

COMMANDS = ("rpm_command", "motor_command", "rate_command", "thrust_command")
Quantities = dict[str, np.ndarray]
STANDIN_LOGS = "standin_logs"
STANDIN_HINT = (
    "; simulate them: quadjax logs standin --policy e2e_nominal --policy indi_shac "
    f"--output runs/{STANDIN_LOGS}"
)
SIGNALS = (
    *("time", "rpm", "rpm_command", "rate_command", "thrust_command", "motor_command", "flying"),
    *("body_velocity", "rates", "specific_force", "position", "attitude"),
)


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
    motor_command: np.ndarray | None = None  # (n, 4) 0 to 1
    speeds_measured: bool = True  # false: ``rpm`` is that of typical motors at the motor commands

    @property
    def sample_rate(self) -> float:
        """Samples per second, Hz."""
        return (len(self.time) - 1) / float(self.time[-1] - self.time[0])

    def flight(self, name: str | None = None) -> Flight:
        """The log as a flight, without gates; not for a log without a position.

        Further signals: "motor_command", "rate_command" and "thrust_command", where
        the log has them, "specific_force" and "flying". "command" and "actuators" are propeller
        speeds. Without an attitude it is NaN, and the velocity is the derivative of the position.

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
        if self.rpm_command is not None:
            signals["command"] = Signal(self.rpm_command, "rpm", MOTORS)
        if self.speeds_measured:
            signals["actuators"] = Signal(self.rpm, "rpm", MOTORS)
        if self.motor_command is not None:
            signals["motor_command"] = Signal(self.motor_command, "", MOTORS)
        if self.rate_command is not None:
            signals["rate_command"] = Signal(self.rate_command, "rad/s", RATES)
        if self.thrust_command is not None:
            signals["thrust_command"] = Signal(self.thrust_command[:, None], "m/s^2", ("thrust",))
        signals["specific_force"] = Signal(self.specific_force, "m/s^2", AXES)
        signals["flying"] = Signal(self.flying[:, None].astype(np.float64))
        source = {"note": "flight log", "path": self.path}
        return Flight(name or self.name, self.time, signals, source=source)

    def __getitem__(self, rows: slice) -> Self:
        """The flight at some consecutive samples."""
        parts = {
            name: value[rows]
            for name, value in vars(self).items()
            if name in SIGNALS and value is not None
        }
        return replace(self, **parts)


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
    own = log_format(config.format)

    def select(header: list[str]) -> list[str]:
        wanted = _wanted(path, config, own, header)
        return [name for group in wanted.values() for name in group]

    return _log_of_table(own.table(path, select), config, own, path)


def log_of_columns(columns: Quantities, config: LogsConfig, path: Path | str) -> FlightLog:
    """A flight log from columns (n,), finite numbers each, by the names of ``config``.

    Args:
        columns: of a table, in the config's units and frames.
        config: of the columns; ``files`` is not used.
        path: of the table; its stem is the name of the log.

    Raises:
        InputError: as ``read_log``.
    """
    own = log_format(config.format)
    wanted = _wanted(path, config, own, list(columns))
    table = table_of_columns(columns, path, [name for group in wanted.values() for name in group])
    return _log_of_table(replace(table, first_row=2), config, own, path)


def _wanted(
    path: Path | str, config: LogsConfig, own: LogFormat, header: list[str]
) -> dict[str, list[str]]:
    """Names of the columns to read, by quantity."""
    wanted = wanted_columns(config, header, own.columns, own.alternatives)
    for quantity in REQUIRED:
        if quantity not in wanted:
            raise InputError(f"{path}: no columns for {quantity} (logs.columns.{quantity})")
    for either, columns in (
        ("rpm or motor_command", {"rpm", "motor_command"}),
        ("body_velocity or world_velocity", {"body_velocity", "world_velocity"}),
    ):
        if not columns & set(wanted):
            raise InputError(f"{path}: no columns for {either} (logs.columns)")
    if "body_velocity" not in wanted and not set(ATTITUDES) & set(wanted):
        raise InputError(
            f"{path}: world_velocity needs columns for {', '.join(ATTITUDES[:-1])} or "
            f"{ATTITUDES[-1]} (logs.columns)"
        )
    return wanted


def _log_of_table(
    table: LogTable, config: LogsConfig, own: LogFormat, path: Path | str
) -> FlightLog:
    config = resolved(config)
    wanted = _wanted(path, config, own, list(table.columns))
    quantities = _quantities(table, wanted, config, own, path)
    recording = Recording(str(path), table, wanted, quantities)
    check_time(recording, config)
    check_attitude(recording)
    quantities = own.adjusted(path, quantities, table.settings)
    recording = replace(recording, quantities=quantities)
    check_variation(recording)
    check_own_frames(recording)
    quantities, config = to_standard_frames(quantities, config)
    check_units(replace(recording, quantities=quantities), config)
    if config.world_frame == "ENU":  # the names in the order of north, east, down
        ordered = {quantity: wanted[quantity] for quantity in WORLD if quantity in wanted}
        wanted |= {quantity: [names[i] for i in (1, 0, 2)] for quantity, names in ordered.items()}
    even, flying = _evenly(quantities)
    even["acceleration"] = even["acceleration"] - even.pop("acceleration_bias", 0.0)
    rate = (len(flying) - 1) / float(even["time"][-1] - even["time"][0])
    unchecked = tuple(check_consistency(str(path), wanted, even, rate, flying, config))
    if "rpm" not in even:
        wanted = wanted | {"rpm": wanted["motor_command"]}
        even["rpm"] = typical_speeds(even["motor_command"], rate)
    return FlightLog(
        name=Path(path).stem,
        path=str(path),
        time=even["time"],
        rpm=even["rpm"],
        speeds_measured="rpm" in quantities,
        **{name: even.get(name) for name in COMMANDS},
        body_velocity=even["body_velocity"],
        rates=even["gyro"],
        specific_force=even["acceleration"],
        flying=flying,
        position=even.get("position"),
        attitude=Rotation.from_quat(even["quaternion"]) if "quaternion" in even else None,
        columns=wanted,
        cut_row=table.cut_row,
        unchecked=unchecked,
    )


def _quantities(
    table: LogTable,
    wanted: dict[str, list[str]],
    config: LogsConfig,
    own: LogFormat,
    path: Path | str,
) -> Quantities:
    """Quantities (n,) or (n, k) in SI, rpm, and motor commands from 0 to 1."""
    found: Quantities = {}
    for quantity, group in wanted.items():
        values = np.stack([table.columns[name] for name in group], axis=1)
        values = values * scale_of(quantity, config.units)
        if quantity == "motor_command":
            low, high = config.motor_range or _motor_range(own, table.settings, path)
            values = (values - low) / max(high - low, 1e-9)
        found[quantity] = values[:, 0] if len(group) == 1 else values
    return found


def _motor_range(
    own: LogFormat, settings: Mapping[str, str], path: Path | str
) -> tuple[float, float]:
    """Motor commands that are 0 and 1: of the log's head, or else of the format."""
    if own.motor_setting not in settings:
        return own.motor_range
    span = numbers_of(settings, own.motor_setting)
    if len(span) != 2 or span[0] >= span[1]:
        raise InputError(
            f"{path}: setting {own.motor_setting} is {settings[own.motor_setting]!r:.80}, "
            "allowed: the lowest and the highest command"
        )
    return span[0], span[1]


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


def _evenly(quantities: Quantities) -> tuple[Quantities, np.ndarray]:
    """Quantities at evenly spaced times, and whether in flight; commands by their last value."""
    time, steps = quantities["time"], np.diff(quantities["time"])
    count = len(time)
    if np.ptp(steps) > 0.01 * np.median(steps):
        count = int(round((time[-1] - time[0]) / np.median(steps))) + 1
    even = np.linspace(time[0], time[-1], count)
    nearest = np.clip(np.searchsorted(time, even - 0.5 * np.median(steps)), 0, len(time) - 1)
    result = {"time": even}
    for name in quantities.keys() - {"time", "mode"}:
        values = quantities[name]
        if name in COMMANDS:
            result[name] = values[nearest]
        else:
            values = np.unwrap(values, axis=0) if name == "euler" else values
            result[name] = np.stack([np.interp(even, time, column) for column in values.T], axis=1)
    mode = quantities.get("mode")
    return result, np.ones(count, bool) if mode is None else mode[nearest] > 0
