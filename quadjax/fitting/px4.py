"""PX4's ULog files, through pyulog (the extra ``px4``).

The topics have their own clocks. Everything is brought to the clock of the body rates: measurements
by interpolation, commands by their last value. Velocity and position are logged at 10 Hz: between
their samples the accelerometer is integrated.
"""

import contextlib
import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.files import check_file

MAX_GAP = 0.05  # s, between samples of a topic
MAX_STEP = 0.125  # s, the same of velocity and position
GRAVITY = np.array([0.0, 0.0, 9.81])  # m/s^2
ORDER = (2, 0, 3, 1)  # motors front-left, front-right, rear-right, rear-left


class Field(NamedTuple):
    """A quantity's source: topic, fields, and names of the columns."""

    topic: str
    fields: tuple[str, ...]
    names: tuple[str, ...]


def _axes(name: str, count: int = 3) -> list[str]:
    return [f"{name}[{index}]" for index in range(count)]


COLUMNS = {
    "time": ["timestamp"],
    "rpm": [f"esc[{index}].esc_rpm" for index in ORDER],
    "motor_command": [f"control[{index}]" for index in ORDER],
    "gyro": _axes("xyz"),
    "acceleration": _axes("accelerometer_m_s2"),
    "world_velocity": ["vx", "vy", "vz"],
    "position": ["x", "y", "z"],
    "quaternion": _axes("q", 4),
}


def _field(topic: str, quantity: str, fields: list[str] | None = None) -> Field:
    return Field(topic, tuple(fields or COLUMNS[quantity]), tuple(COLUMNS[quantity]))


CLOCK = _field("vehicle_angular_velocity", "gyro")
FIELDS = (
    _field("sensor_combined", "acceleration"),
    _field("vehicle_local_position", "world_velocity"),
    _field("vehicle_local_position", "position"),
    _field("vehicle_attitude", "quaternion"),
    _field("esc_status", "rpm"),
    _field("actuator_motors", "motor_command"),
)
SECOND_CHOICE = _field("vehicle_acceleration", "acceleration", _axes("xyz"))
HELD = ("actuator_motors",)
SMOOTH = ("vehicle_local_position",)


def read_ulog(path: Path) -> dict[str, np.ndarray]:
    """Columns (n,) of a ULog file, at the times of ``vehicle_angular_velocity``.

    Raises:
        InputError: pyulog is not installed, the file cannot be read, a topic is missing, slow or
            has a gap.
    """
    check_file(path)
    topics = _topics(path)
    if CLOCK.topic not in topics:
        raise InputError(f"{path}: no topic {CLOCK.topic} (SDLOG_PROFILE=17 logs it)")
    sources = [field for field in FIELDS if field.topic in topics]
    if "sensor_combined" not in topics and SECOND_CHOICE.topic in topics:
        sources.append(SECOND_CHOICE)
    if not sources:
        raise InputError(
            f"{path}: no topic other than {CLOCK.topic}, expected at least {FIELDS[0].topic}"
        )
    series = {field: _series(path, topics, field) for field in [CLOCK, *sources]}
    first = max(time[0] for time, _ in series.values())
    last = min(time[-1] for time, _ in series.values())
    clock = series[CLOCK][0]
    clock = clock[(clock >= first) & (clock <= last)]
    if not len(clock):
        raise InputError(f"{path}: the topics have no time in common")
    columns = {"timestamp": clock - clock[0]}
    at_clock = {field.names: _at(clock, *found, field) for field, found in series.items()}
    _integrate_between(clock, at_clock, {field.names: found for field, found in series.items()})
    for names, values in at_clock.items():
        columns |= dict(zip(names, values.T, strict=True))
    return columns


def _integrate_between(
    clock: np.ndarray,
    at_clock: dict[tuple[str, ...], np.ndarray],
    series: dict[tuple[str, ...], tuple[np.ndarray, np.ndarray]],
) -> None:
    """Replace velocity and position at the clock, us, by integrals between their samples."""
    attitude, force, velocity, position = (
        tuple(COLUMNS[name])
        for name in ("quaternion", "acceleration", "world_velocity", "position")
    )
    if not {attitude, force, velocity, position} <= set(at_clock):
        return
    quaternion = at_clock[attitude][:, [1, 2, 3, 0]]
    inside = (series[velocity][0] >= clock[0]) & (series[velocity][0] <= clock[-1])
    if not quaternion.any(axis=1).all() or not inside.any():
        return
    slope = Rotation.from_quat(quaternion).apply(at_clock[force]) + GRAVITY
    for names in (velocity, position):
        time, values = series[names]
        whole = cumulative_trapezoid(slope, 1e-6 * clock, axis=0, initial=0.0)
        offset = values[inside] - _interpolated(time[inside], clock, whole)
        slope = at_clock[names] = whole + _interpolated(clock, time[inside], offset)


def _topics(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """The fields of every topic that is used, of its first instance."""
    try:
        from pyulog import ULog
    except ImportError:
        raise InputError(f"{path}: ULog files need pyulog: pip install 'quadjax[px4]'") from None
    wanted = [CLOCK.topic, SECOND_CHOICE.topic, *(field.topic for field in FIELDS)]
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # warnings of a damaged file
            log: ULog = ULog(str(path), wanted)
    except Exception as error:  # pyulog raises errors of many kinds for a damaged file
        reason = f"{error}".splitlines()[:1] or [type(error).__name__]
        raise InputError(f"{path}: not readable as a ULog file ({reason[0]:.200})") from None
    if log.file_corruption:
        raise InputError(f"{path}: a ULog file with damaged messages, expected a whole one")
    return {data.name: data.data for data in log.data_list if data.multi_id == 0}


def _series(
    path: Path, topics: dict[str, dict[str, np.ndarray]], field: Field
) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,), us, and values (n, k) of a field."""
    data = topics[field.topic]
    for name in field.fields:
        if name not in data:
            raise InputError(f"{path}: topic {field.topic} has no field {name!r}")
    name = "timestamp_sample" if "timestamp_sample" in data else "timestamp"
    time = np.asarray(data[name], np.float64)
    values = np.stack([np.asarray(data[name], np.float64) for name in field.fields], axis=1)
    steps = np.diff(time) * 1e-6
    if len(time) < 2 or (steps <= 0.0).any():
        row = int((steps <= 0.0).argmax()) + 1 if len(time) > 1 else 0
        raise InputError(f"{path}: topic {field.topic}, sample {row}: time does not increase")
    usual, longest = float(np.median(steps)), float(steps.max())
    step = MAX_STEP if field.topic in SMOOTH else MAX_GAP
    most = step if usual > step else max(step, 2.5 * usual)
    if longest > most:
        raise InputError(
            f"{path}: topic {field.topic}, sample {steps.argmax() + 1}: a gap of {longest:.3g} s "
            f"among samples {usual:.3g} s apart, allowed: {most:.3g} s (SDLOG_PROFILE=17)"
        )
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        row, column = bad[0]
        raise InputError(
            f"{path}: topic {field.topic}, sample {row}, field {field.fields[column]!r} is "
            f"{values[row, column]}, expected a finite number"
        )
    return time, values


def _at(clock: np.ndarray, time: np.ndarray, values: np.ndarray, field: Field) -> np.ndarray:
    """Values (m, k) at the times of the clock (m,)."""
    if field.topic in HELD:
        return values[np.searchsorted(time, clock, side="right") - 1]
    if (
        field.topic == "vehicle_attitude"
    ):  # q and -q are the same attitude: the sign nearer to the previous one
        turned = (values[1:] * values[:-1]).sum(axis=1) < 0.0
        values = np.concatenate(
            [values[:1], values[1:] * np.cumprod(np.where(turned, -1, 1))[:, None]]
        )
    return _interpolated(clock, time, values)


def _interpolated(at: np.ndarray, time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (m, k) at times (m,) from those (n, k) at times (n,)."""
    return np.stack([np.interp(at, time, column) for column in values.T], axis=1)
