"""Checks of a flight log's time, units and directions by the magnitudes of single columns.

Each check raises an ``InputError`` of one line with the file, the column and the row.
"""

from collections.abc import Mapping
from dataclasses import dataclass

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
LARGEST = {  # quantity: value, unit, and the unit of a larger one
    "gyro": (60.0, "rad/s", "deg/s"),
    "rate_command": (60.0, "rad/s", "deg/s"),
    "thrust_command": (400.0, "m/s^2", "newtons"),
    "acceleration": (400.0, "m/s^2", "milli-g"),
    "acceleration_bias": (10.0, "m/s^2", "milli-g"),
    "body_velocity": (100.0, "m/s", "cm/s"),
    "world_velocity": (100.0, "m/s", "cm/s"),
}
ANGLES = (3.2, 1.6, 1000.0)  # rad, largest roll, pitch and yaw
MEDIANS = (  # of propeller speeds in flight, rpm: from, to, and what else it may be
    (-np.inf, -100.0, "expected no sign"),
    (-100.0, 2000.0, "is this rad/s (logs.units.rpm)?"),
    (60_000.0, np.inf, "is this electrical speed (pole pairs times the propeller's)?"),
)
SPEEDS = (-100.0, 100_000.0)  # rpm, lowest and highest


@dataclass(frozen=True)
class Recording:
    """Columns of a log by quantity, (n,) or (n, k) in SI and rpm, and their places in the file."""

    path: str
    table: LogTable
    names: Mapping[str, list[str]]
    quantities: dict[str, np.ndarray]

    def error(self, row: int, columns: str, problem: str) -> InputError:
        """A problem of some columns at a sample."""
        return InputError(f"{self.path}: {self.table.where(int(row))}, {columns}{problem}")

    @property
    def flying(self) -> np.ndarray:
        """Rows in flight: by the log's mode, or else by propeller speed."""
        mode = self.quantities.get("mode")
        if mode is not None and (mode > 0).any():
            return mode > 0
        speeds = self.quantities.get("rpm", self.quantities.get("motor_command"))
        mean = np.abs(speeds).mean(axis=1)
        return mean >= 0.5 * np.median(mean)


def check_time(log: Recording, config: LogsConfig) -> None:
    """Time must increase without gaps, for long enough, at a plausible rate."""
    time, column = log.quantities["time"], f"column {log.names['time'][0]!r}: "
    last = len(time) - 1
    if len(time) < LEAST_ROWS:
        problem = f"the file ends after {len(time)} rows of data, expected at least {LEAST_ROWS}"
        raise log.error(last, column, problem)
    steps = np.diff(time)
    row = int((steps <= 0.0).argmax())
    if steps[row] <= 0.0:
        word = "runs backwards" if steps[row] < 0.0 else "stands still"
        problem = f"time {word}, from {time[row]:.6g} to {time[row + 1]:.6g} s"
        raise log.error(row + 1, column, problem)
    usual, seconds = float(np.median(steps)), time[-1] - time[0]
    if not 2e-4 < usual < 0.051:
        problem = f"samples are {usual:.3g} s apart, expected 0.0002 to 0.05 s; is "
        raise log.error(1, column, problem + "logs.units.time right?")
    longest = max(config.max_gap, 2.5 * usual)
    row = int(steps.argmax())
    if steps[row] > longest:
        problem = f"a gap of {steps[row]:.3g} s, allowed: {longest:.3g} s (logs.max_gap)"
        raise log.error(row + 1, column, problem)
    if seconds < config.min_seconds:
        problem = f"the file ends after {seconds:.3g} s, expected at least {config.min_seconds:g} s"
        raise log.error(last, column, problem)


def check_attitude(log: Recording) -> None:
    """Rotation matrices must have the determinant 1, quaternions a length above 0."""
    for form, size_of in (("rotation", _determinant), ("quaternion", _length)):
        if form not in log.quantities:
            continue
        size, word = size_of(log.quantities[form]), size_of.__name__.strip("_")
        bad = np.abs(size - 1.0) > DETERMINANT_SLACK if form == "rotation" else size == 0.0
        if bad.any():
            row = int(bad.argmax())
            problem = f"an attitude with a {word} of {size[row]:.3g}, expected 1"
            raise log.error(row, f"column {log.names[form][0]!r} and on: ", problem)


def _determinant(rotation: np.ndarray) -> np.ndarray:
    return np.linalg.det(rotation.reshape(-1, 3, 3))


def _length(quaternion: np.ndarray) -> np.ndarray:
    return np.linalg.norm(quaternion, axis=1)


def check_variation(log: Recording) -> None:
    """Reject a column with one value throughout the flight, which no measurement has."""
    rows = log.flying
    for quantity in log.quantities.keys() - MAY_BE_CONSTANT:
        for name, values in zip(log.names[quantity], log.quantities[quantity].T, strict=True):
            if np.ptp(values[rows]) == 0.0:
                raise InputError(
                    f"{log.path}: column {name!r} is {values[rows][0]:.6g} throughout the flight, "
                    f"expected a measurement of {quantity}"
                )


def check_own_frames(log: Recording) -> None:
    """Motor commands must be within 0 and 1 in flight, angles must be radians."""
    commands = log.quantities.get("motor_command")
    if commands is not None:
        beyond = (commands < -COMMAND_SLACK) | (commands > 1.0 + COMMAND_SLACK)
        for row, i in np.argwhere(beyond & log.flying[:, None])[:1]:
            problem = f"a motor command of {commands[row, i]:.4g} in flight, expected 0 to 1; is "
            column = f"column {log.names['motor_command'][i]!r}: "
            raise log.error(row, column, problem + "logs.motor_range right?")
    angles = log.quantities.get("euler", np.zeros((1, 3)))
    for axis, largest in enumerate(ANGLES):
        row = int(np.abs(angles[:, axis]).argmax())
        if abs(angles[row, axis]) > largest:
            problem = f"an angle of {angles[row, axis]:.3g} rad; is this in degrees "
            column = f"column {log.names['euler'][axis]!r}: "
            raise log.error(row, column, problem + "(logs.units.angle)?")


def check_units(log: Recording, config: LogsConfig) -> None:
    """Magnitudes must be those of a flying quadcopter; others indicate a wrong unit or frame."""
    for quantity in ("rpm", "rpm_command"):
        if quantity in log.quantities:
            _check_speeds(log, quantity)
    _check_levels(log, 1.0 + config.max_scale_error)
    _check_thrust(log)
    for quantity, (largest, unit, other) in LARGEST.items():
        if quantity not in log.names:
            continue
        values = log.quantities[quantity].reshape(len(log.quantities["time"]), -1)
        row, axis = np.unravel_index(int(np.abs(values).argmax()), values.shape)
        if abs(values[row, axis]) > largest:
            problem = f" is {values[row, axis]:.4g} {unit}, expected at most {largest:g}; is this "
            column = f"column {log.names[quantity][int(axis)]!r}"
            raise log.error(int(row), column, problem + f"in {other}?")


def _check_speeds(log: Recording, quantity: str) -> None:
    rows, (lowest, highest) = np.flatnonzero(log.flying), SPEEDS
    for name, values in zip(log.names[quantity], log.quantities[quantity].T, strict=True):
        middle = float(np.median(values[rows]))
        for low, high, hint in MEDIANS:
            if low < middle < high:
                problem = f"a median of {middle:.4g} rpm in flight; {hint}"
                raise log.error(rows[0], f"column {name!r} and on: ", problem)
        for row in np.flatnonzero((values < lowest) | (values > highest))[:1]:
            problem = f" is {values[row]:.4g} rpm, expected 0 to {highest:g}"
            raise log.error(row, f"column {name!r}", problem)


def _check_levels(log: Recording, largest: float) -> None:
    """The motors turn at about the same speed, and at that of their commands."""
    rows, quantities = log.flying, log.quantities
    if "rpm" not in quantities:
        return
    medians = np.median(quantities["rpm"][rows], axis=0)
    for i, name in enumerate(log.names["rpm"]):
        factor = medians[i] / np.delete(medians, i).mean()
        if not 1.0 / largest <= factor <= largest:
            raise InputError(
                f"{log.path}: column {name!r} is {factor:.3g} times the other motors' speeds "
                f"(median {medians[i]:.4g} rpm); allowed: logs.max_scale_error"
            )
    if "rpm_command" in quantities:
        factor = float(np.median(np.median(quantities["rpm_command"][rows], axis=0) / medians))
        if not 1.0 / largest <= factor <= largest:
            names = ", ".join(map(repr, log.names["rpm_command"]))
            raise InputError(
                f"{log.path}: columns {names} are {factor:.3g} times the speeds "
                f"{', '.join(map(repr, log.names['rpm']))} (logs.units.rpm, logs.max_scale_error)"
            )


def _check_thrust(log: Recording) -> None:
    """The specific force is about that of gravity, along -z."""
    rows, names = np.flatnonzero(log.flying), log.names["acceleration"]
    airborne, column = log.quantities["acceleration"][rows], f"column {names[2]!r} and on: "
    size = float(np.median(np.linalg.norm(airborne, axis=1)))
    if not 0.4 * GRAVITY < size < 5.0 * GRAVITY:
        hint = "is this in g (logs" if size < GRAVITY else "is the unit right (logs"
        problem = f"a median of {size:.3g} m/s^2 in flight, expected about {GRAVITY}; {hint}"
        raise log.error(rows[0], column, problem + ".units.acceleration)?")
    middle = np.median(airborne, axis=0)
    largest = int(np.abs(middle).argmax())
    if largest != 2 and middle[2] > -0.5 * abs(middle[largest]):
        problem = f"the thrust is in column {names[largest]!r} ({middle[largest]:+.3g} m/s^2); are "
        raise log.error(rows[0], column, problem + f"{names[2]!r} and {names[largest]!r} swapped?")
    if middle[2] > 0.0:
        problem = f"the specific force points down ({middle[2]:+.3g} m/s^2), expected negative "
        raise log.error(
            rows[0], column, problem + "with z down; is this a z-up frame (logs.body_frame FLU)?"
        )
