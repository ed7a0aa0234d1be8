"""Faults of the link: states and commands that are lost or late, wrong units, NaN.

Faults are drawn from a seed and counted. Delays are in simulated time.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping

import numpy as np

DEGREES = 180.0 / math.pi
RPM_PER_RAD_S = 30.0 / math.pi
FIELDS = {  # fields of a state that can be NaN, and their names in ``VEHICLE``
    "position": "position",
    "velocity": "velocity",
    "attitude": "euler",
    "quaternion": "quaternion",
    "rates": "rates",
    "rotor_speed": "rotor_speed",
    "thrust": "thrust",
    "gyro": "gyro",
    "specific_force": "specific_force",
    "moment": "moment_ext",
    "force": "force_ext",
}
# Units that replace those of a state: the fields of ``VEHICLE``, and the factor.
WRONG_UNITS: dict[str, tuple[tuple[str, ...], float]] = {
    "attitude=deg": (("euler",), DEGREES),
    "rates=deg/s": (("rates", "gyro"), DEGREES),
    "position=mm": (("position",), 1000.0),
    "velocity=cm/s": (("velocity", "body_velocity"), 100.0),
    "rotor_speed=rpm": (("rotor_speed",), RPM_PER_RAD_S),
}


@dataclasses.dataclass(frozen=True)
class Faults:
    """Probabilities for each state and command, and wrong numbers of the states."""

    drop: float = 0.0
    late: float = 0.0
    delay: float = 0.02  # s, of a late one
    nan: Mapping[str, float] = dataclasses.field(default_factory=dict)  # by name in FIELDS
    units: tuple[str, ...] = ()  # of WRONG_UNITS

    def __bool__(self) -> bool:
        """Whether any fault can occur."""
        return bool(self.drop or self.late or any(self.nan.values()) or self.units)

    @property
    def of_commands(self) -> "Faults":
        """The faults that commands can have too."""
        return dataclasses.replace(self, nan={}, units=())


@dataclasses.dataclass(frozen=True)
class Sent:
    """A state or a command in transit."""

    due: float  # s, simulated
    number: int  # of the control step
    data: np.ndarray


class Channel:
    """One direction of the link, with its faults.

    Attributes:
        counts: number of states or commands by what happened to them.
    """

    def __init__(self, faults: Faults, seed: int, stream: int) -> None:
        """Start with nothing in transit; ``stream`` separates channels with the same seed."""
        self.counts: Counter[str] = Counter()
        self._faults, self._waiting = faults, list[Sent]()
        self._random = np.random.default_rng((seed, stream))

    def push(self, data: np.ndarray, number: int, now: float) -> None:
        """Send the state or command of a control step at a simulated time, s."""
        faults, data = self._faults, data.copy()
        drop, delay, _ = self._random.uniform(size=3)  # two numbers would change every seed
        self._alter(data)
        dropped, late = drop < faults.drop, delay < faults.late
        self.counts["dropped"] += int(dropped)
        self.counts["late"] += int(late and not dropped)
        if not dropped:
            self._waiting.append(Sent(now + faults.delay if late else now, number, data))

    def due(self, now: float) -> list[Sent]:
        """What arrives until a simulated time, s, in order of arrival."""
        arrived = [sent for sent in self._waiting if sent.due <= now + 1e-9]
        self._waiting = [sent for sent in self._waiting if sent.due > now + 1e-9]
        return sorted(arrived, key=lambda sent: sent.due)

    def _alter(self, data: np.ndarray) -> None:
        """Set wrong units and NaN."""
        for unit in self._faults.units:
            names, factor = WRONG_UNITS[unit]
            for name in names:
                data[name] *= np.float32(factor)
        for name, probability in self._faults.nan.items():
            value = data[FIELDS[name]].reshape(-1)  # a view
            at = int(self._random.integers(len(value)))
            if self._random.uniform() < probability:
                value[at] = np.nan
                self.counts["with NaN"] += 1
