"""Checks of a flight log's time, units and signs.

Each check raises an ``InputError`` of one line with the file, the column and the row.
"""

from typing import NamedTuple

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.csv_table import LogTable

GRAVITY = 9.81
LEAST_ROWS = 50  # of a log, for the filters
DETERMINANT_SLACK = 0.1  # of a rotation matrix, from 1
COMMAND_SLACK = 0.02  # of a motor command beyond its range
MAY_BE_CONSTANT = {
    *("time", "mode", "acceleration_bias"),
    *("rpm_command", "motor_command", "rate_command", "thrust_command", "rotation"),
}


class Source(NamedTuple):
    """A log and its table, for messages."""

    path: str
    table: LogTable

    def __str__(self) -> str:
        return self.path

    def at(self, index: int) -> str:
        """The path, and the place of a sample in the file."""
        return f"{self.path}: {self.table.where(int(index))}"


def check_time(source: "Source", column: str, time: np.ndarray, config: LogsConfig) -> None:
    """Time must increase without gaps, for long enough, at a plausible rate."""

    def refuse(row: int, problem: str) -> InputError:
        return InputError(f"{source.at(row)}, column {column!r}: {problem}")

    if len(time) < LEAST_ROWS:
        raise refuse(
            len(time) - 1,
            f"the file ends after {len(time)} rows of data, expected at least {LEAST_ROWS}",
        )
    steps = np.diff(time)
    row = int((steps <= 0.0).argmax())
    if steps[row] <= 0.0:
        word = "runs backwards" if steps[row] < 0.0 else "stands still"
        raise refuse(row + 1, f"time {word}, from {time[row]:.6g} to {time[row + 1]:.6g} s")
    usual = float(np.median(steps))
    if not 2e-4 < usual < 0.051:
        raise refuse(
            1,
            f"samples are {usual:.3g} s apart, expected 0.0002 to 0.05 s; is logs.units.time "
            "right?",
        )
    most = max(config.max_gap, 2.5 * usual)
    row = int((steps > most).argmax())
    if steps[row] > most:
        raise refuse(row + 1, f"a gap of {steps[row]:.3g} s, allowed: {most:.3g} s (logs.max_gap)")
    seconds = time[-1] - time[0]
    if seconds < config.min_seconds:
        raise refuse(
            len(time) - 1,
            f"the file ends after {seconds:.3g} s, expected at least {config.min_seconds:g} s",
        )


def check_constant(
    source: "Source", columns: dict[str, list[str]], quantities: dict[str, np.ndarray]
) -> None:
    """Reject a column with one value throughout the flight, which no measurement has."""
    rows = _flying(quantities)
    for quantity in set(quantities) - MAY_BE_CONSTANT:
        for name, values in zip(columns[quantity], quantities[quantity].T, strict=True):
            if np.ptp(values[rows]) == 0.0:
                raise InputError(
                    f"{source}: column {name!r} is {values[rows][0]:.6g} throughout the flight, "
                    f"expected a measurement of {quantity}"
                )


def check_units(
    source: "Source", columns: dict[str, list[str]], quantities: dict[str, np.ndarray]
) -> None:
    """Magnitudes must be those of a flying quadcopter; others indicate a wrong unit or frame."""
    if "rpm" in quantities:
        _check_rpm(source, columns, quantities, "rpm")
    if "rpm_command" in quantities:
        _check_rpm(source, columns, quantities, "rpm_command")
    _check_acceleration(source, columns["acceleration"], quantities)
    velocity = columns.get("body_velocity") or columns["world_velocity"]
    for quantity, names, limit, unit, other in (
        ("gyro", columns["gyro"], 60.0, "rad/s", "deg/s"),
        ("rate_command", columns.get("rate_command"), 60.0, "rad/s", "deg/s"),
        ("thrust_command", columns.get("thrust_command"), 400.0, "m/s^2", "newtons"),
        ("acceleration", columns["acceleration"], 400.0, "m/s^2", "milli-g"),
        ("acceleration_bias", columns.get("acceleration_bias"), 10.0, "m/s^2", "milli-g"),
        ("body_velocity", velocity, 100.0, "m/s", "cm/s"),
    ):
        if quantity in quantities:
            values = quantities[quantity].reshape(-1, len(names))
            _check_largest(source, names, values, limit, unit, other)


def _flying(quantities: dict[str, np.ndarray]) -> np.ndarray:
    """Rows in flight: by the log's mode, or else by propeller speed."""
    mode = quantities.get("mode")
    if mode is not None and (mode > 0).any():
        return mode > 0
    speeds = quantities.get("rpm", quantities.get("motor_command"))
    mean = np.abs(speeds).mean(axis=1)
    return mean >= 0.5 * np.median(mean)


def check_motor_commands(
    source: "Source", columns: dict[str, list[str]], quantities: dict[str, np.ndarray]
) -> None:
    """Motor commands in flight must be within 0 and 1, up to ``COMMAND_SLACK``."""
    rows = _flying(quantities)
    for name, values in zip(columns["motor_command"], quantities["motor_command"].T, strict=True):
        bad = np.flatnonzero(rows & ((values < -COMMAND_SLACK) | (values > 1.0 + COMMAND_SLACK)))
        if bad.size:
            raise InputError(
                f"{source.at(bad[0])}, column {name!r}: a motor command of {values[bad[0]]:.4g} in "
                "flight, expected 0 to 1; is logs.motor_range right?"
            )


def _check_rpm(
    source: "Source",
    columns: dict[str, list[str]],
    quantities: dict[str, np.ndarray],
    quantity: str,
) -> None:
    rows = np.flatnonzero(_flying(quantities))
    for name, values in zip(columns[quantity], quantities[quantity].T, strict=True):
        where = f"{source.at(rows[0])}, column {name!r} and on"
        middle = float(np.median(values[rows]))
        hint = None
        if middle < -100.0:
            hint = "expected no sign"
        elif middle < 2000.0:
            hint = "is this rad/s (logs.units.rpm)?"
        elif middle > 60_000.0:
            hint = "is this electrical speed (pole pairs times the propeller's)?"
        if hint:
            raise InputError(f"{where}: a median of {middle:.4g} rpm in flight; {hint}")
        bad = np.flatnonzero((values < -100.0) | (values > 100_000.0))
        if bad.size:
            raise InputError(
                f"{source.at(bad[0])}, column {name!r} is {values[bad[0]]:.4g} rpm, "
                "expected 0 to 100000"
            )


def _check_acceleration(
    source: "Source", columns: list[str], quantities: dict[str, np.ndarray]
) -> None:
    rows = np.flatnonzero(_flying(quantities))
    airborne = quantities["acceleration"][rows]
    size = float(np.median(np.linalg.norm(airborne, axis=1)))
    where = f"{source.at(rows[0])}, column {columns[2]!r} and on"
    if not 0.4 * GRAVITY < size < 5.0 * GRAVITY:
        hint = "is this in g (logs" if size < GRAVITY else "is the unit right (logs"
        raise InputError(
            f"{where}: a median of {size:.3g} m/s^2 in flight, expected about {GRAVITY}; "
            f"{hint}.units.acceleration)?"
        )
    middle = np.median(airborne, axis=0)
    most = int(np.abs(middle).argmax())
    if most != 2 and middle[2] > -0.5 * abs(middle[most]):
        raise InputError(
            f"{where}: the thrust is in column {columns[most]!r} ({middle[most]:+.3g} m/s^2); are "
            f"{columns[2]!r} and {columns[most]!r} swapped?"
        )
    if middle[2] > 0.0:
        raise InputError(
            f"{where}: the specific force points down ({middle[2]:+.3g} m/s^2), expected negative "
            "with z down; is this a z-up frame (logs.body_frame FLU)?"
        )


def check_attitude(
    source: "Source", columns: dict[str, list[str]], quantities: dict[str, np.ndarray]
) -> None:
    """Rotation matrices must have the determinant 1, quaternions a length above 0."""
    sizes = {}
    if "rotation" in quantities:
        size = np.linalg.det(quantities["rotation"].reshape(-1, 3, 3))
        sizes["rotation"] = (size, np.abs(size - 1.0) > DETERMINANT_SLACK, "determinant")
    if "quaternion" in quantities:
        size = np.linalg.norm(quantities["quaternion"], axis=1)
        sizes["quaternion"] = (size, size == 0.0, "length")
    for quantity, (size, bad, word) in sizes.items():
        if bad.any():
            row = int(bad.argmax())
            raise InputError(
                f"{source.at(row)}, column {columns[quantity][0]!r} and on: an attitude with a "
                f"{word} of {size[row]:.3g}, expected 1"
            )


def check_angles(source: "Source", names: list[str], angles: np.ndarray) -> None:
    """Roll, pitch and yaw (n, 3) of the log must be radians."""
    for axis, limit in ((0, 3.2), (1, 1.6), (2, 1000.0)):
        row = int(np.abs(angles[:, axis]).argmax())
        if abs(angles[row, axis]) > limit:
            raise InputError(
                f"{source.at(row)}, column {names[axis]!r}: an angle of "
                f"{angles[row, axis]:.3g} rad; is this in degrees (logs.units.angle)?"
            )


def _check_largest(
    source: "Source", names: list[str], values: np.ndarray, limit: float, unit: str, other: str
) -> None:
    row, axis = np.unravel_index(int(np.abs(values).argmax()), values.shape)
    if abs(values[row, axis]) > limit:
        raise InputError(
            f"{source.at(row)}, column {names[int(axis)]!r} is "
            f"{values[row, axis]:.4g} {unit}, expected at most {limit:g}; is this in {other}?"
        )
