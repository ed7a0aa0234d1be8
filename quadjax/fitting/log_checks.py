"""Checks of a flight log that has been read: its time, its units and its signs.

Each check raises an ``InputError`` of one line with the file, the column and the row.
"""

from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.config import LogsConfig

GRAVITY = 9.81


def check_time(path: Path | str, column: str, time: np.ndarray, config: LogsConfig) -> None:
    """Time must run forwards without gaps, for long enough, at a plausible rate."""
    if len(time) < 2:
        raise InputError(
            f"{path}: row {len(time) + 1}, column {column!r}: the file ends here, after "
            f"{len(time)} rows of data, expected at least {config.min_seconds:g} s of flight"
        )
    steps = np.diff(time)
    backwards = np.flatnonzero(steps <= 0.0)
    if backwards.size:
        row = int(backwards[0])
        word = "runs backwards" if steps[row] < 0.0 else "stands still"
        raise InputError(
            f"{path}: row {row + 3}, column {column!r}: time {word}, "
            f"from {time[row]:.6g} to {time[row + 1]:.6g} s"
        )
    usual = float(np.median(steps))
    if not 2e-4 < usual < 0.051:
        raise InputError(
            f"{path}: row 3, column {column!r}: samples are {usual:.3g} s apart, expected 0.0002 "
            "to 0.05 s; is logs.units.time right?"
        )
    gaps = np.flatnonzero(steps > max(config.max_gap, 2.5 * usual))
    if gaps.size:
        row = int(gaps[0])
        raise InputError(
            f"{path}: row {row + 3}, column {column!r}: a gap of {steps[row]:.3g} s, "
            f"allowed: {max(config.max_gap, 2.5 * usual):.3g} s (logs.max_gap)"
        )
    if time[-1] - time[0] < config.min_seconds:
        raise InputError(
            f"{path}: row {len(time) + 1}, column {column!r}: the file ends after "
            f"{time[-1] - time[0]:.3g} s, expected at least {config.min_seconds:g} s"
        )


def check_units(
    path: Path | str, columns: dict[str, list[str]], quantities: dict[str, np.ndarray]
) -> None:
    """Magnitudes that no flying quadcopter shows betray a wrong unit, sign or frame."""
    _check_rpm(path, columns, quantities, "rpm")
    if "rpm_command" in quantities:
        _check_rpm(path, columns, quantities, "rpm_command")
    _check_acceleration(path, columns["acceleration"], quantities)
    if "euler" in quantities:
        _check_gyro(path, columns, quantities)
    _check_largest(path, columns["gyro"], quantities["gyro"], 60.0, "rad/s", "deg/s")
    _check_largest(
        path, columns["acceleration"], quantities["acceleration"], 400.0, "m/s^2", "milli-g"
    )
    _check_largest(
        path,
        columns.get("body_velocity") or columns["world_velocity"],
        quantities["body_velocity"],
        100.0,
        "m/s",
        "cm/s",
    )


def _flying(quantities: dict[str, np.ndarray]) -> np.ndarray:
    """Rows that look like flight: by the log's own mode, else by the propellers."""
    mode = quantities.get("mode")
    if mode is not None and (mode > 0).any():
        return mode > 0
    mean = quantities["rpm"].mean(axis=1)
    return mean >= 0.5 * np.median(mean)


def _check_rpm(
    path: Path | str,
    columns: dict[str, list[str]],
    quantities: dict[str, np.ndarray],
    quantity: str,
) -> None:
    rows = np.flatnonzero(_flying(quantities))
    for name, values in zip(columns[quantity], quantities[quantity].T, strict=True):
        where = f"{path}: row {int(rows[0]) + 2}, column {name!r} and on"
        middle = float(np.median(values[rows]))
        if middle < 2000.0:
            raise InputError(
                f"{where}: {middle:.4g} rpm in the middle of a flight; is this rad/s "
                "(logs.units.rpm)?"
            )
        if middle > 60_000.0:
            raise InputError(
                f"{where}: {middle:.4g} rpm in the middle of a flight; is this electrical speed "
                "(pole pairs times the propeller's)?"
            )
        bad = np.flatnonzero((values < -100.0) | (values > 100_000.0))
        if bad.size:
            raise InputError(
                f"{path}: row {int(bad[0]) + 2}, column {name!r} is {values[bad[0]]:.4g} rpm, "
                "expected 0 to 100000"
            )


def _check_acceleration(
    path: Path | str, columns: list[str], quantities: dict[str, np.ndarray]
) -> None:
    rows = np.flatnonzero(_flying(quantities))
    flown = quantities["acceleration"][rows]
    size = float(np.median(np.linalg.norm(flown, axis=1)))
    where = f"{path}: row {int(rows[0]) + 2}, column {columns[2]!r} and on"
    if size < 0.4 * GRAVITY:
        raise InputError(
            f"{where}: {size:.3g} m/s^2 in the middle of a flight, expected about {GRAVITY}; is "
            "this in g (logs.units.acceleration)?"
        )
    if size > 5.0 * GRAVITY:
        raise InputError(
            f"{where}: {size:.3g} m/s^2 in the middle of a flight, expected about {GRAVITY}; is "
            "logs.units.acceleration right?"
        )
    if np.median(flown[:, 2]) > 0.0:
        raise InputError(
            f"{where}: the specific force points down ({np.median(flown[:, 2]):+.3g} m/s^2), "
            "expected negative with z down; is this a z-up frame (logs.body_frame FLU)?"
        )


def check_angles(path: Path | str, names: list[str], angles: np.ndarray) -> None:
    """Roll, pitch and yaw (n, 3) as the log has them must look like radians."""
    for axis, limit in ((0, 3.2), (1, 1.6), (2, 1000.0)):
        row = int(np.abs(angles[:, axis]).argmax())
        if abs(angles[row, axis]) > limit:
            raise InputError(
                f"{path}: row {row + 2}, column {names[axis]!r}: an angle of "
                f"{angles[row, axis]:.3g} rad; is this in degrees (logs.units.angle)?"
            )


def _check_gyro(
    path: Path | str, columns: dict[str, list[str]], quantities: dict[str, np.ndarray]
) -> None:
    """The gyro must be what the angles' derivative says."""
    slope, likeness = _gyro_against_angles(quantities)
    if likeness > 0.5 and not 0.2 < slope < 5.0:
        row = int(np.abs(quantities["gyro"][:, 0]).argmax())
        raise InputError(
            f"{path}: row {row + 2}, column {columns['gyro'][0]!r} and on: the gyro is "
            f"{slope:.3g} times what the angles do; is this in deg/s (logs.units.gyro)?"
        )
    if likeness < -0.7:
        raise InputError(
            f"{path}: row 2, column {columns['gyro'][0]!r} and on: the gyro turns against the "
            "angles; are logs.body_frame and logs.world_frame right?"
        )


def _gyro_against_angles(quantities: dict[str, np.ndarray]) -> tuple[float, float]:
    """Slope and correlation of the measured with the angles' roll and pitch rates."""
    span = max(1, int(round(0.04 / np.median(np.diff(quantities["time"])))))
    time, gyro = quantities["time"], quantities["gyro"]
    roll, pitch, yaw = (np.unwrap(angle) for angle in quantities["euler"].T)
    width = (time[2 * span :] - time[: -2 * span])[:, None]
    angles = np.stack([roll, pitch, yaw], axis=1)
    turn = (angles[2 * span :] - angles[: -2 * span]) / width
    sums = np.cumsum(np.concatenate([np.zeros((1, 3)), gyro]), axis=0)
    mean = (sums[2 * span + 1 :] - sums[: -2 * span - 1]) / (2 * span + 1)
    middle = slice(span, len(time) - span)
    sx, cx, sy, cy = (f(a[middle]) for a in (roll, pitch) for f in (np.sin, np.cos))
    expected = np.concatenate(
        [turn[:, 0] - sy * turn[:, 2], cx * turn[:, 1] + sx * cy * turn[:, 2]]
    )
    measured = np.concatenate([mean[:, 0], mean[:, 1]])
    energy = float(expected @ expected)
    if energy < 1e-4 * len(expected):  # too still to tell
        return 1.0, 0.0
    product = float(expected @ measured)
    return product / energy, product / np.sqrt(energy * float(measured @ measured) + 1e-12)


def _check_largest(
    path: Path | str, names: list[str], values: np.ndarray, limit: float, unit: str, other: str
) -> None:
    row, axis = np.unravel_index(int(np.abs(values).argmax()), values.shape)
    if abs(values[row, axis]) > limit:
        raise InputError(
            f"{path}: row {int(row) + 2}, column {names[int(axis)]!r} is "
            f"{values[row, axis]:.4g} {unit}, expected at most {limit:g}; is this in {other}?"
        )
