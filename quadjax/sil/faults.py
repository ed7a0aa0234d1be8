"""Faults of the states that an autopilot gets: lost, late, stuck, wrong units, NaN.

Faults are drawn from a seed and counted. Delays are in simulated time.
"""

import dataclasses
import math
from collections import Counter
from collections.abc import Mapping

import numpy as np

from quadjax.vehicle.airframe import RPM_PER_RAD_S

DEGREES = 180.0 / math.pi
FIELDS = {  # fields of a state that can be stuck or NaN, and their names in ``VEHICLE``
    "position": "position",
    "velocity": "velocity",
    "attitude": "quaternion",
    "rates": "rates",
    "rotor_speed": "rotor_speed",
    "thrust": "thrust",
    "specific_force": "specific_force",
}
# Units that replace those of a state: the fields of ``VEHICLE``, and the factor.
WRONG_UNITS: dict[str, tuple[tuple[str, ...], float]] = {
    "rates=deg/s": (("rates",), DEGREES),
    "position=mm": (("position",), 1000.0),
    "velocity=cm/s": (("velocity", "body_velocity"), 100.0),
    "rotor_speed=rpm": (("rotor_speed",), RPM_PER_RAD_S),
}


@dataclasses.dataclass(frozen=True)
class Faults:
    """Probabilities for each state, and wrong numbers."""

    drop: float = 0.0
    late: float = 0.0
    delay: float = 0.02  # s, of a late one
    stuck: Mapping[str, float] = dataclasses.field(default_factory=dict)  # by name in FIELDS
    nan: Mapping[str, float] = dataclasses.field(default_factory=dict)  # by name in FIELDS
    units: tuple[str, ...] = ()  # of WRONG_UNITS

    def __bool__(self) -> bool:
        """Whether any fault can occur."""
        numbers = (self.drop, self.late, *self.stuck.values(), *self.nan.values())
        return any(numbers) or bool(self.units)


class Channel:
    """The way of the states to the autopilot, with its faults.

    Attributes:
        counts: number of states by what happened to them.
    """

    def __init__(self, faults: Faults, seed: int) -> None:
        """Start with nothing on the way."""
        self.counts: Counter[str] = Counter()
        self._faults, self._random = faults, np.random.default_rng((seed, 0))
        self._waiting = list[tuple[float, np.ndarray]]()  # when they are due, s
        self._sent: np.ndarray | None = None  # the state before, as it was sent
        self._arrived: np.ndarray | None = None

    def newest(self, state: np.ndarray, now: float) -> np.ndarray | None:
        """Send a ``VEHICLE`` () at a simulated time, s; the newest that has arrived, if any has."""
        faults, sent = self._faults, state.copy()
        drop, delay = self._random.uniform(size=2)
        self._alter(sent)
        dropped, late = drop < faults.drop, delay < faults.late
        self.counts["dropped"] += int(dropped)
        self.counts["late"] += int(late and not dropped)
        if not dropped:
            self._waiting.append((now + faults.delay if late else now, sent))
        due = [(when, one) for when, one in self._waiting if when <= now + 1e-9]
        self._waiting = [(when, one) for when, one in self._waiting if when > now + 1e-9]
        for _, one in sorted(due, key=lambda pair: pair[0]):
            self._arrived = one
        return self._arrived

    def _alter(self, state: np.ndarray) -> None:
        """Set wrong units, numbers of the state before, and NaN."""
        for unit in self._faults.units:
            names, factor = WRONG_UNITS[unit]
            for name in names:
                state[name] *= np.float32(factor)
        for name, probability in self._faults.stuck.items():
            if self._random.uniform() < probability and self._sent is not None:
                state[FIELDS[name]] = self._sent[FIELDS[name]]
                self.counts["stuck"] += 1
        self._sent = state.copy()
        for name, probability in self._faults.nan.items():
            value = state[FIELDS[name]].reshape(-1)  # a view
            at = int(self._random.integers(len(value)))
            if self._random.uniform() < probability:
                value[at] = np.nan
                self.counts["with NaN"] += 1
