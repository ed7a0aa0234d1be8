"""PX4's ULog files, through pyulog (the extra ``px4``).

The topics have their own clocks. Everything is brought to the clock of the body rates: measurements
by interpolation, commands by their last value. Velocity and position are logged at 10 Hz: between
their samples the accelerometer is integrated. A topic slower than 20 Hz, or 8 Hz for these, is
rejected; ``esc_status`` is left out, and the motors are fitted by their effect. Times at which a
topic has a longer gap are left out (``logs.max_gap``). Of several instances of a topic the first is
read. Without ``sensor_combined``, ``vehicle_acceleration`` is read. ``SDLOG_PROFILE`` has to be
17, the profiles "default" and "high rate" together. The profile "default" alone logs the commands
at 10 Hz; "high rate" alone logs no position.
"""

import contextlib
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from quadjax.core.contents import ULOG, ULOG_MAGIC, check_kind
from quadjax.core.errors import InputError
from quadjax.core.files import check_file
from quadjax.fitting.log_table import LogTable, continuous, interpolated, time_fault
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
ESC = "esc_status"
MOST_MOTORS = 12  # of a topic
STALE = 3  # samples at the start of a topic that may be of long before
OTHER = ("vehicle_acceleration", COLUMNS["gyro"])  # of the acceleration
Fields = dict[str, np.ndarray]  # of a topic, each (n,)
Series = tuple[np.ndarray, np.ndarray]  # times (n,), us, and values (n, k)


def read_ulog(path: Path) -> LogTable:
    """Columns (n,) of a ULog file, at the times of ``vehicle_angular_velocity``.

    Raises:
        InputError: pyulog is not installed, the file cannot be read, a topic is missing or slow.
    """
    check_file(path)
    check_kind(path, ULOG, ULOG)
    topics, left_out = _topics(path)
    if CLOCK not in topics:
        raise InputError(f"{path}: no topic {CLOCK} (SDLOG_PROFILE=17 logs it)")
    if len(topics) == 1:
        expected = SOURCES["acceleration"][0]
        raise InputError(f"{path}: no topic other than {CLOCK}, expected at least {expected}")
    if HELD not in topics and ESC not in topics:
        raise InputError(f"{path}: no topic {HELD} or {ESC} (SDLOG_PROFILE=17 logs them)")
    sources = dict(SOURCES)
    if SOURCES["acceleration"][0] not in topics:
        sources["acceleration"] = OTHER
    if ESC in topics and HELD in topics and (usual := _usual(topics[ESC])) > MAX_GAP:
        left_out.append(f"topic {ESC} (a sample every {usual:.2g} s, allowed: {MAX_GAP:g} s)")
        del topics[ESC]
    series = {
        quantity: _series(path, topics[topic], topic, _fields(topics[topic], quantity, fields))
        for quantity, (topic, fields) in sources.items()
        if topic in topics
    }
    clock = _common_clock(path, series)
    columns = {"timestamp": clock - clock[0]}
    at_clock = _at_clock(clock, series)
    for quantity, (topic, fields) in sources.items():
        if quantity in at_clock:
            known = dict(zip(fields, COLUMNS[quantity], strict=True))
            names = _fields(topics[topic], quantity, fields)
            values = zip(names, at_clock[quantity].T, strict=True)
            columns |= {known.get(name, name): column for name, column in values}
    return _without_gaps(path, columns, clock, series, sources, left_out)


def _common_clock(path: Path, series: dict[str, Series]) -> np.ndarray:
    """Times (n,), us, of the body rates at which there are all other series."""
    first = max(time[0] for time, _ in series.values())
    last = min(time[-1] for time, _ in series.values())
    clock = series["gyro"][0]
    clock = clock[(clock >= first) & (clock <= last)]
    if not len(clock):
        raise InputError(f"{path}: the topics have no time in common")
    return clock


def _at_clock(clock: np.ndarray, series: dict[str, Series]) -> dict[str, np.ndarray]:
    """All quantities (n, k) at times (n,), us."""
    at_clock = {}
    for quantity, (time, values) in series.items():
        if quantity == "motor_command":
            at_clock[quantity] = values[np.searchsorted(time, clock, side="right") - 1]
        else:
            values = continuous(values) if quantity == "quaternion" else values
            at_clock[quantity] = interpolated(clock, time, values)
    return at_clock | _integrated(clock, at_clock, series)


def _without_gaps(
    path: Path,
    columns: dict[str, np.ndarray],
    clock: np.ndarray,
    series: dict[str, Series],
    sources: Mapping[str, tuple[str, list[str]]],
    left_out: Sequence[str],
) -> LogTable:
    """The log without times at which a topic has a gap, and the topics of its gaps."""
    kept = np.ones(len(clock), bool)
    ends: dict[float, str] = {}  # topics by the first time after a gap, us
    for quantity, (time, _) in series.items():
        topic = sources[quantity][0]
        steps = 1e-6 * np.diff(time)
        for gap in np.flatnonzero(steps > _longest(topic, float(np.median(steps)))):
            kept &= (clock <= time[gap]) | (clock >= time[gap + 1])
            ends.setdefault(float(time[gap + 1]), topic)
    causes: dict[int, str] = {}
    for end, topic in ends.items():
        causes.setdefault(int(kept[clock < end].sum()), f" in topic {topic}")
    columns = {name: values[kept] for name, values in columns.items()}
    return LogTable(str(path), columns, left_out=tuple(left_out), causes=causes)


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


def _topics(path: Path) -> tuple[dict[str, Fields], list[str]]:
    """The fields of every topic that is used, of its first instance, and names of the others."""
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
    topics: dict[str, Fields] = {}
    others = []
    for data in sorted(log.data_list, key=lambda data: data.multi_id):
        if data.name in topics:
            others.append(f"topic {data.name}, instance {data.multi_id}")
        topics.setdefault(data.name, data.data)
    return topics, others


def _fields(data: Fields, quantity: str, fields: list[str]) -> list[str]:
    """The fields of a quantity, and those of further motors that are used."""
    if quantity not in ("rpm", "motor_command"):
        return fields
    first, second = re.split(r"\d+", fields[0], maxsplit=1)
    further = [f"{first}{index}{second}" for index in range(len(fields), MOST_MOTORS)]
    return [*fields, *(name for name in further if name in data and np.any(data[name] > 0))]


def _usual(data: Fields) -> float:
    """Usual time between the samples of a topic, s."""
    time = _times(data)
    return float(np.median(np.diff(time))) * 1e-6 if len(time) > 1 else 0.0


def _times(data: Fields) -> np.ndarray:
    return np.asarray(data.get("timestamp_sample", data["timestamp"]), np.float64)


def _longest(topic: str, usual: float) -> float:
    """The longest step between samples of a topic that is no gap, s, by the usual one."""
    step = MAX_STEP if topic == SLOW else MAX_GAP
    return step if usual > step else max(step, 2.5 * usual)


def _series(path: Path, data: Fields, topic: str, fields: list[str]) -> Series:
    """The samples of some fields of a topic, without old ones at the start."""
    for name in fields:
        if name not in data:
            raise InputError(f"{path}: topic {topic} has no field {name!r}")
    time, usual = _times(data), _usual(data)
    longest, start = _longest(topic, usual), 0
    while start < min(STALE, len(time) - 2) and time[start + 1] - time[start] > 1e6 * longest:
        start += 1
    slow = usual > longest
    if fault := time_fault(1e-6 * time[start:], longest if slow else np.inf):
        row, problem = fault
        hint = " (SDLOG_PROFILE=17)" * slow
        raise InputError(f"{path}: topic {topic}, sample {start + row}: {problem}{hint}")
    values = np.stack([np.asarray(data[name], np.float64) for name in fields], axis=1)
    return time[start:], values[start:]
