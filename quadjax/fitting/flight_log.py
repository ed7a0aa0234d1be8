"""Flight logs: reading, checking, and conversion to one set of units and frames.

A file is read as a table, its columns become quantities in SI and rpm, these are brought to body
FRD and world NED and to evenly spaced times, and they are compared with one another.
"""

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.files import whole_file
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.consistency import check_consistency
from quadjax.fitting.formats import QUANTITIES, WRITTEN_PLAIN, Quantities, log_format, named_columns
from quadjax.fitting.log_table import LogTable, read_csv, read_head
from quadjax.fitting.magnitudes import check_attitude, check_columns, check_time
from quadjax.fitting.quantities import (
    called,
    check_motors,
    convert_quantities,
    evenly,
    find_units,
    further_motors,
    second_sensors,
    to_standard_frames,
    wanted_columns,
)
from quadjax.flights.flight import AXES, MOTORS, RATES, Flight, Signal, motion_signals
from quadjax.vehicle.airframe import RPM_PER_RAD_S

STANDIN_LOGS = "standin_logs"
STANDIN_HINT = (
    f"; simulate them: quadjax logs standin --policy e2e --policy indi --output runs/{STANDIN_LOGS}"
)
SIGNALS = {  # of a flight: name, unit and labels by quantity
    "rpm_command": ("command", "rpm", MOTORS),
    "rpm": ("actuators", "rpm", MOTORS),
    "motor_command": ("motor_command", "", MOTORS),
    "rate_command": ("rate_command", "rad/s", RATES),
    "thrust_command": ("thrust_command", "m/s^2", ("thrust",)),
    "body_velocity": ("body_velocity", "m/s", AXES),
    "acceleration": ("specific_force", "m/s^2", AXES),
    "flying": ("flying", "", ()),
}


def log_flight(path: Path | str, quantities: Quantities, **source: Any) -> Flight:
    """A flight of the quantities of a log, without gates.

    Its signals are "position", "velocity", "attitude", "rates", and those of ``SIGNALS`` that the
    log has: "command" and "actuators" are propeller speeds. A missing position or attitude is NaN.
    Without an attitude the velocity is the derivative of the position.

    Args:
        path: of the log, whose stem is the name of the flight.
        quantities: evenly sampled, (n,) or (n, k), in SI and rpm, body FRD and world NED; with
            "time", "gyro", "acceleration", "body_velocity" and "flying". Quaternions have the
            scalar last.
        source: further facts about the flight.
    """
    time, body = quantities["time"], quantities["body_velocity"]
    position = quantities.get("position", np.full_like(body, np.nan))
    if "quaternion" in quantities:
        rotation = Rotation.from_quat(quantities["quaternion"])
        velocity, attitude = rotation.apply(body), rotation.as_euler("ZYX")[:, ::-1]
    else:
        velocity, attitude = np.gradient(position, time, axis=0), np.full_like(body, np.nan)
    motion = {"position": position, "velocity": velocity, "attitude": attitude}
    signals = motion_signals(motion | {"rates": quantities["gyro"]})
    for quantity, (name, unit, labels) in SIGNALS.items():
        if quantity in quantities:
            columns = np.asarray(quantities[quantity], np.float64).reshape(len(time), -1)
            signals[name] = Signal(columns, unit, labels)
    about = {"note": "flight log", "path": str(path)}
    return Flight(Path(path).stem, time, signals, source=about | source)


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
        files = _expand(Path(), pattern) or _expand(folder, pattern)
        if not files:
            if Path(pattern).is_dir() and pattern:
                example = Path(pattern) / "*.csv"
                raise InputError(f"logs.files: {pattern} is a folder, allowed: {example}, files")
            hint = STANDIN_HINT if STANDIN_LOGS in Path(pattern).parts else ""
            raise InputError(f"{pattern or repr(pattern)}: no such file (logs.files){hint}")
        paths += [path for path in files if path not in paths]
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
        paths = anchor.glob(str(whole.relative_to(anchor)))
        return sorted(path for path in paths if path.is_file())
    except (IndexError, RuntimeError, ValueError):  # the root, ~ of no user, or no pattern
        return []


def read_logs(
    config: LogsConfig, folder: Path, report: Callable[[str], None] = lambda line: None
) -> list[Flight]:
    """Read every flight of a config; ``report`` is called with the progress.

    Arguments and errors as ``find_logs`` and ``read_log``.
    """
    logs = []
    for path in find_logs(config, folder):
        report(f"reading {path.name}")
        logs.append(read_log(path, config))
    return logs


def read_log(path: Path | str, config: LogsConfig) -> Flight:
    """Read one flight log.

    A last row of a CSV file that no line break ends is left out: its last number may be cut.

    Returns:
        The flight, evenly sampled; see ``log_flight``. Its ``source`` has "path"; "unchecked", the
        columns without evidence of sign and order; "gaps", the lengths, s, of those between samples
        that are not in flight therefore; "left_out", what the file has and is not read; and
        "rpm_unit", the unit of the speeds with its factor to rpm, or None.

    Raises:
        InputError: a missing column, a cell that is no finite number, a time that does not increase
            or has a gap, an implausible unit, a column that contradicts the others, a file that is
            empty or too short; one line with the file, the column and the row.
    """
    form = log_format(config.format)
    if form.read is not None:
        table = called(form.read, path, Path(path))
        if isinstance(table, Mapping):
            table = LogTable(str(path), table)
        if not isinstance(table, LogTable):
            raise InputError(f"{path}: the reader gives {table!r:.40}, expected columns by name")
        return _flight(table, config)
    header = read_head(path, form.settings)[0]
    wanted = wanted_columns(path, config, form, header)
    names = [name for group in wanted.values() for name in group]
    table = read_csv(path, names, form.settings)
    if further := further_motors(wanted, header):
        with contextlib.suppress(InputError):  # columns without numbers are of no motor
            table = read_csv(path, [*names, *further], form.settings)
    left_out = (*table.left_out, *second_sensors(wanted, header))
    return _flight(replace(table, left_out=left_out), config)


def log_of_columns(columns: Quantities, config: LogsConfig, path: Path | str) -> Flight:
    """A flight from columns (n,) by name, the first sample in row 2 of a file.

    Arguments and errors as ``read_log``; the stem of the path is the name of the flight.
    """
    return _flight(LogTable(str(path), columns, first_row=2), config)


def _flight(table: LogTable, config: LogsConfig) -> Flight:
    form, path = log_format(config.format), table.path
    names = wanted_columns(path, config, form, list(table.columns))
    left_out = [*table.left_out, *check_motors(table, names, config)]
    units = find_units(table, names, config, form)
    quantities = convert_quantities(table, names, units, config, form)
    check_time(table, names, quantities, config)
    check_attitude(table, names, quantities)
    if form.adjust is not None:
        quantities = called(form.adjust, path, quantities, table.settings)
    check_columns(table, names, quantities, units, config)
    frames = (config.body_frame or form.body_frame, config.world_frame or form.world_frame)
    standard, frames = to_standard_frames(quantities, *frames)
    if frames[1] == "ENU":  # the names in the order of north, east, down
        world = [name for name in names if QUANTITIES[name].frame == "world"]
        names = names | {name: [names[name][i] for i in (1, 0, 2)] for name in world}
    even, flying, gaps = evenly(standard)
    even["acceleration"] = even["acceleration"] - even.pop("acceleration_bias", 0.0)
    rate = (len(flying) - 1) / float(even["time"][-1] - even["time"][0])
    unchecked = check_consistency(path, names, units, even, rate, flying, frames, config)
    even["flying"] = flying
    facts = {"unchecked": unchecked, "gaps": gaps.tolist(), "left_out": left_out}
    facts["rpm_unit"] = units.get("rpm")
    return log_flight(path, even, **facts)


def highest_speed(logs: Sequence[Flight]) -> float:
    """The highest speed of some flights, m/s, to 0.1 m/s."""
    speeds = [np.linalg.norm(log["body_velocity"], axis=1)[log.flying].max() for log in logs]
    return round(float(max(speeds)), 1)


def write_flight(path: Path | str, flight: Flight) -> None:
    """Write a flight of the model ``racing`` under a rate policy as a plain log."""
    quantities = {
        "time": flight.time,
        "rpm": RPM_PER_RAD_S * flight["actuators"],
        "motor_command": flight["command"],
        "rate_command": flight["rate_command"],
        "thrust_command": flight["thrust_command"],
        "gyro": flight["rates"],
        "acceleration": flight["specific_force"],
        "body_velocity": flight.rotation.inv().apply(flight["velocity"]),
        "position": flight["position"],
        "euler": flight["attitude"],
    }
    write_log(path, named_columns(quantities, WRITTEN_PLAIN))


def write_log(path: Path | str, columns: Quantities) -> None:
    """Write columns (n,) as a CSV flight log."""
    with whole_file(path) as temporary:
        table = np.stack(list(columns.values()), axis=1)
        header = ",".join(columns)
        np.savetxt(temporary, table, fmt="%.8g", delimiter=",", header=header, comments="")
