"""Faults of the link: messages that are dropped, late or damaged, wrong units, NaN.

Faults are drawn from a seed and counted. Delays are in simulated time, so that a race with faults
is the same at every speed.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping

import numpy as np

from quadjax.sil.message import DTYPES, RPM_PER_RAD_S, Kind, pack

DEGREES = 180.0 / math.pi
FIELDS = {  # fields of a state that can be NaN, by their names without frame and unit
    "position": "position_ned_m",
    "velocity": "velocity_ned_m_s",
    "attitude": "attitude_rpy_rad",
    "quaternion": "quaternion_wxyz",
    "rates": "rates_frd_rad_s",
    "rotor_speed": "rotor_speed_rad_s",
    "thrust": "thrust_m_s2",
    "gyro": "gyro_frd_rad_s",
    "specific_force": "specific_force_frd_m_s2",
    "moment": "moment_frd_n_m",
    "force": "force_frd_m_s2",
}
# Units that replace those of a state: the fields, and the factor.
WRONG_UNITS: dict[str, tuple[tuple[str, ...], float]] = {
    "attitude=deg": (("attitude_rpy_rad",), DEGREES),
    "rates=deg/s": (("rates_frd_rad_s", "gyro_frd_rad_s"), DEGREES),
    "position=mm": (("position_ned_m",), 1000.0),
    "velocity=cm/s": (("velocity_ned_m_s", "velocity_frd_m_s"), 100.0),
    "rotor_speed=rpm": (("rotor_speed_rad_s",), RPM_PER_RAD_S),
}


@dataclasses.dataclass(frozen=True)
class Faults:
    """Probabilities for each message, of either direction, and wrong units of the states."""

    drop: float = 0.0
    late: float = 0.0
    delay: float = 0.02  # s, of a late message
    damage: float = 0.0  # one bit is flipped
    nan: Mapping[str, float] = dataclasses.field(default_factory=dict)  # by name in FIELDS
    units: tuple[str, ...] = ()  # of WRONG_UNITS

    def __bool__(self) -> bool:
        """Whether any fault can occur."""
        return bool(self.drop or self.late or self.damage or any(self.nan.values()) or self.units)


@dataclasses.dataclass(frozen=True)
class Sent:
    """A message under way."""

    due: float  # s, simulated
    data: bytes
    sequence: int
    intact: bool = True


class Channel:
    """One direction of the link, with its faults.

    Attributes:
        counts: number of messages by what happened to them.
    """

    def __init__(self, faults: Faults, seed: int, stream: int) -> None:
        """No message is under way; channels of one seed differ by the number of ``stream``."""
        self.counts: Counter[str] = Counter()
        self._faults, self._waiting = faults, list[Sent]()
        self._random = np.random.default_rng((seed, stream))

    def push(self, message: np.ndarray, now: float) -> None:
        """Send a message at a simulated time, s."""
        faults, draws = self._faults, self._random.uniform(size=3)
        if message.dtype == DTYPES[Kind.STATE]:
            message = self._altered(message)
        data, intact = pack(message), draws[2] >= faults.damage
        if not intact:
            data = _flipped(data, int(self._random.integers(8 * len(data))))
        dropped, late = draws[0] < faults.drop, draws[1] < faults.late
        self.counts["sent"] += 1
        self.counts["dropped"] += int(dropped)
        self.counts["late"] += int(late and not dropped)
        self.counts["damaged"] += int(not intact and not dropped)
        if not dropped:
            due = now + faults.delay if late else now
            self._waiting.append(Sent(due, data, int(message["sequence"]), bool(intact)))

    def due(self, now: float) -> list[Sent]:
        """The messages that arrive until a simulated time, s, in order of arrival."""
        arrived = [sent for sent in self._waiting if sent.due <= now + 1e-9]
        self._waiting = [sent for sent in self._waiting if sent.due > now + 1e-9]
        return sorted(arrived, key=lambda sent: sent.due)

    def _altered(self, message: np.ndarray) -> np.ndarray:
        """A state with wrong units and NaN."""
        message = message.copy()
        for unit in self._faults.units:
            names, factor = WRONG_UNITS[unit]
            for name in names:
                message[name] *= np.float32(factor)
        for name, probability in self._faults.nan.items():
            value = message[FIELDS[name]].reshape(-1)  # a view
            at = int(self._random.integers(len(value)))
            if self._random.uniform() < probability:
                value[at] = np.nan
                self.counts["with NaN"] += 1
        return message


def _flipped(data: bytes, bit: int) -> bytes:
    """Bytes with one bit flipped."""
    flipped = bytearray(data)
    flipped[bit // 8] ^= 1 << bit % 8
    return bytes(flipped)
