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
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from quadjax.core.contents import ULOG, ULOG_MAGIC, check_kind
from quadjax.core.errors import InputError
from quadjax.core.files import check_file
from quadjax.fitting.log_table import LogTable, continuous, indexed_alike, interpolated, time_fault
from quadjax.vehicle.airframe import GRAVITY_M_S2

MAX_GAP_S = 0.05  # between samples of a topic
MAX_SLOW_GAP_S = 0.125  # the same of velocity and position
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
HEADER_BYTES = 16
STALE_SAMPLES = 3  # samples at the start of a topic that may be of long before
OTHER = ("vehicle_acceleration", COLUMNS["gyro"])  # of the acceleration
Fields = dict[str, np.ndarray]  # of a topic, each (n,)


class Series(NamedTuple):
    """The samples of some fields of a topic."""

    topic: str
    names: list[str]  # of the columns, k of them
    time: np.ndarray  # (n,) us
    values: np.ndarray  # (n, k)
    longest: float  # s, step between samples that is no gap


def read_ulog(path: Path) -> LogTable:
    """Columns (n,) of a ULog file, at the times of ``vehicle_angular_velocity``.

    Raises:
        InputError: pyulog is not installed, the file cannot be read, a topic is missing or slow.
    """
    check_file(path)
    check_kind(path, ULOG, ULOG)
    content = path.read_bytes()
    if content.count(ULOG_MAGIC) > 1:
        raise InputError(f"{path}: two ULog files in one, expected one log in a file")
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
    if ESC in topics and HELD in topics and (usual := _usual(_times(topics[ESC]))) > MAX_GAP_S:
        left_out.append(f"topic {ESC} (a sample every {usual:.2g} s, allowed: {MAX_GAP_S:g} s)")
        del topics[ESC]
    series = {
        quantity: _series(path, topics[topic], topic, fields, COLUMNS[quantity])
        for quantity, (topic, fields) in sources.items()
        if topic in topics
    }
    clock = _common_clock(path, series)
    if _is_cut(content):
        seconds = 1e-6 * (clock[-1] - clock[0])
        left_out.append(f"the end of the file, whose last message is cut, after {seconds:.3g} s")
    return _table(path, clock, series, left_out)


def _is_cut(content: bytes) -> bool:
    """Whether the last message of a ULog file is not whole."""
    at = HEADER_BYTES
    while at + 3 <= len(content):  # the size of a message, two bytes, and its kind precede it
        at += 3 + int.from_bytes(content[at : at + 2], "little")
    return at != len(content)


def _common_clock(path: Path, series: Mapping[str, Series]) -> np.ndarray:
    """Times (n,), us, of the body rates at which there are all other series."""
    first = max(part.time[0] for part in series.values())
    last = min(part.time[-1] for part in series.values())
    clock = series["gyro"].time
    clock = clock[(clock >= first) & (clock <= last)]
    if not len(clock):
        raise InputError(f"{path}: the topics have no time in common")
    return clock


def _table(
    path: Path, clock: np.ndarray, series: Mapping[str, Series], left_out: Sequence[str]
) -> LogTable:
    """All columns at times (n,), us, at which no topic has a gap, and the topics of the gaps."""
    columns, at_clock = {"timestamp": clock - clock[0]}, _at_clock(clock, series)
    for quantity, part in series.items():
        columns |= dict(zip(part.names, at_clock[quantity].T, strict=True))
    gaps = [
        (part.time[i], part.time[i + 1], part.topic)
        for part in series.values()
        for i in np.flatnonzero(1e-6 * np.diff(part.time) > part.longest)
    ]
    kept = np.ones(len(clock), bool)
    for start, end, _ in gaps:
        kept &= (clock <= start) | (clock >= end)
    causes = {int(np.searchsorted(clock[kept], end)): f" in topic {t}" for _, end, t in gaps}
    columns = {name: values[kept] for name, values in columns.items()}
    return LogTable(str(path), columns, left_out=tuple(left_out), causes=causes)


def _at_clock(clock: np.ndarray, series: Mapping[str, Series]) -> dict[str, np.ndarray]:
    """All quantities (n, k) at times (n,), us."""
    at_clock = {}
    for quantity, part in series.items():
        if part.topic == HELD:
            last = np.searchsorted(part.time, clock, side="right") - 1
            at_clock[quantity] = part.values[last]
        else:
            values = continuous(part.values) if quantity == "quaternion" else part.values
            at_clock[quantity] = interpolated(clock, part.time, values)
    return at_clock | _integrated(clock, at_clock, series)


def _integrated(
    clock: np.ndarray, at_clock: Mapping[str, np.ndarray], series: Mapping[str, Series]
) -> dict[str, np.ndarray]:
    """Velocity and position at the clock, us, by integrals between their samples."""
    if not {"quaternion", "acceleration", "world_velocity"} <= set(series):
        return {}
    quaternion, force = at_clock["quaternion"], at_clock["acceleration"]
    slow = series["world_velocity"].time
    inside = (slow >= clock[0]) & (slow <= clock[-1])
    usable = np.isfinite(quaternion).all() and quaternion.any(axis=1).all() and inside.any()
    if not usable:
        return {}
    slope = Rotation.from_quat(quaternion[:, [1, 2, 3, 0]]).apply(force) + [0.0, 0.0, GRAVITY_M_S2]
    result = {}
    for quantity in ("world_velocity", "position"):
        time, values = series[quantity].time, series[quantity].values
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
    if log.file_corruption:
        raise InputError(f"{path}: a ULog file with damaged messages, expected a whole one")
    topics: dict[str, Fields] = {}
    others = []
    for data in sorted(log.data_list, key=lambda data: data.multi_id):
        if data.name in topics:
            others.append(f"topic {data.name}, instance {data.multi_id}")
        topics.setdefault(data.name, data.data)
    return topics, others


def _times(data: Fields) -> np.ndarray:
    """Times (n,) of the samples of a topic, us."""
    return np.asarray(data.get("timestamp_sample", data["timestamp"]), np.float64)


def _usual(time: np.ndarray) -> float:
    """Usual step between times (n,), us, in s."""
    return 1e-6 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0


def _series(path: Path, data: Fields, topic: str, fields: list[str], names: list[str]) -> Series:
    """The samples of some fields of a topic, without old ones at the start.

    Further motors follow the four of a quadcopter. Commands are NaN while PX4 is disarmed: those at
    both ends are left out.
    """
    further = indexed_alike(fields, list(data)) if topic in (HELD, ESC) else []
    count, fields, names = len(fields), [*fields, *further], [*names, *further]
    for name in fields:
        if name not in data:
            raise InputError(f"{path}: topic {topic} has no field {name!r}")
    values = np.stack([np.asarray(data[name], np.float64) for name in fields], axis=1)
    time, rows = _times(data), np.arange(len(values))
    if topic == HELD and (armed := np.flatnonzero(np.isfinite(values[:, :count]).all(1))).size:
        rows = rows[armed[0] : armed[-1] + 1]
    usual, step = _usual(time), MAX_SLOW_GAP_S if topic == SLOW else MAX_GAP_S
    slow, longest = usual > step, max(step, 2.5 * usual)
    for _ in range(STALE_SAMPLES):
        if len(rows) > 2 and np.diff(time[rows[:2]]) > 1e6 * longest:
            rows = rows[1:]
    if fault := time_fault(1e-6 * time[rows], step if slow else np.inf):
        row, problem = fault
        hint = " (SDLOG_PROFILE=17)" * slow
        raise InputError(f"{path}: topic {topic}, sample {rows[row]}: {problem}{hint}")
    return Series(topic, names, time[rows], values[rows], longest)
