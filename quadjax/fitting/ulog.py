"""PX4's ULog files, through pyulog (the extra ``px4``).

The topics have their own clocks. Everything is brought to the clock of the body rates: measurements
by interpolation, commands by their last value. Velocity and position are logged at 10 Hz: between
their samples the accelerometer is integrated. A topic slower than 20 Hz, or 8 Hz for these, is
rejected. Without ``sensor_combined``, ``vehicle_acceleration`` is read. ``SDLOG_PROFILE`` has to be
17, the profiles "default" and "high rate" together. The profile "default" alone logs the commands
at 10 Hz; "high rate" alone logs no position.
"""

import contextlib
import io
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from quadjax.core.contents import ULOG, ULOG_MAGIC, check_kind
from quadjax.core.errors import InputError
from quadjax.core.files import check_file
from quadjax.fitting.log_table import continuous, interpolated, time_fault
from quadjax.vehicle.airframe import GRAVITY

MAX_GAP = 0.05  # s, between samples of a topic
MAX_STEP = 0.125  # s, the same of velocity and position
ORDER = (2, 0, 3, 1)  # motors front-left, front-right, rear-right, rear-left
COLUMNS = {
    "time": ["timestamp"],
    "rpm": [f"esc[{index}].esc_rpm" for index in ORDER],
    "motor_command": [f"control[{index}]" for index in ORDER],
    "gyro": [f"xyz[{index}]" for index in range(3)],
    "acceleration": [f"accelerometer_m_s2[{index}]" for index in range(3)],
    "world_velocity": ["vx", "vy", "vz"],
    "position": ["x", "y", "z"],
    "quaternion": [f"q[{index}]" for index in range(4)],
}
CLOCK, HELD, SLOW = "vehicle_angular_velocity", "actuator_motors", "vehicle_local_position"
SOURCES = {  # topic and fields by quantity; fields of another topic in place of the first
    "gyro": (CLOCK, COLUMNS["gyro"]),
    "acceleration": ("sensor_combined", COLUMNS["acceleration"]),
    "world_velocity": (SLOW, COLUMNS["world_velocity"]),
    "position": (SLOW, COLUMNS["position"]),
    "quaternion": ("vehicle_attitude", COLUMNS["quaternion"]),
    "rpm": ("esc_status", COLUMNS["rpm"]),
    "motor_command": (HELD, COLUMNS["motor_command"]),
}
OTHER = ("vehicle_acceleration", COLUMNS["gyro"])  # of the acceleration
Series = tuple[np.ndarray, np.ndarray]  # times (n,), us, and values (n, k)


def read_ulog(path: Path) -> dict[str, np.ndarray]:
    """Columns (n,) of a ULog file, at the times of ``vehicle_angular_velocity``.

    Raises:
        InputError: pyulog is not installed, the file cannot be read, a topic is missing, slow or
            has a gap.
    """
    check_file(path)
    check_kind(path, ULOG, ULOG)
    topics = _topics(path)
    if CLOCK not in topics:
        raise InputError(f"{path}: no topic {CLOCK} (SDLOG_PROFILE=17 logs it)")
    sources = dict(SOURCES)
    if SOURCES["acceleration"][0] not in topics:
        sources["acceleration"] = OTHER
    series = {
        quantity: _series(path, topics[topic], topic, fields)
        for quantity, (topic, fields) in sources.items()
        if topic in topics
    }
    if len(series) == 1:
        expected = SOURCES["acceleration"][0]
        raise InputError(f"{path}: no topic other than {CLOCK}, expected at least {expected}")
    first = max(time[0] for time, _ in series.values())
    last = min(time[-1] for time, _ in series.values())
    clock = series["gyro"][0]
    clock = clock[(clock >= first) & (clock <= last)]
    if not len(clock):
        raise InputError(f"{path}: the topics have no time in common")
    at_clock = {}
    for quantity, (time, values) in series.items():
        if quantity == "motor_command":
            at_clock[quantity] = values[np.searchsorted(time, clock, side="right") - 1]
        else:
            values = continuous(values) if quantity == "quaternion" else values
            at_clock[quantity] = interpolated(clock, time, values)
    at_clock |= _integrated(clock, at_clock, series)
    columns = {"timestamp": clock - clock[0]}
    for quantity, values in at_clock.items():
        columns |= dict(zip(COLUMNS[quantity], values.T, strict=True))
    return columns


def _integrated(
    clock: np.ndarray, at_clock: dict[str, np.ndarray], series: dict[str, Series]
) -> dict[str, np.ndarray]:
    """Velocity and position at the clock, us, by integrals between their samples."""
    if not {"quaternion", "acceleration", "world_velocity"} <= set(series):
        return {}
    quaternion, force = at_clock["quaternion"], at_clock["acceleration"]
    slow = series["world_velocity"][0]
    inside = (slow >= clock[0]) & (slow <= clock[-1])
    usable = np.isfinite(quaternion).all() and quaternion.any(axis=1).all() and inside.any()
    if not usable:
        return {}
    slope = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).apply(force) + [0.0, 0.0, GRAVITY]
    result = {}
    for quantity in ("world_velocity", "position"):
        time, values = series[quantity]
        whole = cumulative_trapezoid(slope, 1e-6 * clock, axis=0, initial=0.0)
        offset = values[inside] - interpolated(time[inside], clock, whole)
        slope = result[quantity] = whole + interpolated(clock, time[inside], offset)
    return result


def _topics(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """The fields of every topic that is used, of its first instance."""
    try:
        from pyulog import ULog
    except ImportError:
        raise InputError(f"{path}: ULog files need pyulog: pip install 'quadjax[px4]'") from None
    wanted = [OTHER[0], *(topic for topic, _ in SOURCES.values())]
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # warnings of a damaged file
            log: ULog = ULog(str(path), wanted)
    except Exception as error:  # pyulog raises errors of many kinds for a damaged file
        reason = f"{error}".splitlines()[:1] or [type(error).__name__]
        raise InputError(f"{path}: not readable as a ULog file ({reason[0]:.200})") from None
    if path.read_bytes().count(ULOG_MAGIC) > 1:
        raise InputError(f"{path}: two ULog files in one, expected one log in a file")
    if log.file_corruption:
        raise InputError(f"{path}: a ULog file with damaged messages, expected a whole one")
    return {data.name: data.data for data in log.data_list if data.multi_id == 0}


def _series(path: Path, data: dict[str, np.ndarray], topic: str, fields: list[str]) -> Series:
    """The samples of some fields of a topic."""
    for name in fields:
        if name not in data:
            raise InputError(f"{path}: topic {topic} has no field {name!r}")
    time = np.asarray(data.get("timestamp_sample", data["timestamp"]), np.float64)
    step = MAX_STEP if topic == SLOW else MAX_GAP
    usual = float(np.median(np.diff(time))) * 1e-6 if len(time) > 1 else 0.0
    longest = step if usual > step else max(step, 2.5 * usual)
    if fault := time_fault(1e-6 * time, longest):
        row, problem = fault
        raise InputError(f"{path}: topic {topic}, sample {row}: {problem} (SDLOG_PROFILE=17)")
    return time, np.stack([np.asarray(data[name], np.float64) for name in fields], axis=1)
