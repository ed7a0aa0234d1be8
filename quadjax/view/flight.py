"""Flights to show: arrays in world NED and body FRD, and where they pass the gates."""

import dataclasses
from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

RATE = 100.0  # samples per second of flights that are resampled
LONGEST_STEP, SHORTEST_STEP = 0.0201, 0.0079  # s, of flights that are shown as they are
REACH = 0.3  # m beyond an opening, within which a flight without targets passes a gate
TURNS = {"rpm": 1.0 / 60.0, "rad/s": 0.5 / np.pi}  # per second, of one unit of a rotor speed
MOTORS = ("front left", "front right", "rear right", "rear left")


class Gate(Protocol):
    """What is needed of a gate; ``GateSection`` of ``quadjax.race.track`` has it. World NED, m."""

    @property
    def position(self) -> tuple[float, float, float]:
        """Center."""

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the opening."""

    @property
    def shape(self) -> Literal["rectangle", "circle"]:
        """Of the opening."""

    @property
    def axes(self) -> list[list[float]]:
        """Matrix with columns through the gate, along its width and along its height."""


@dataclasses.dataclass(frozen=True)
class Strip:
    """Signals that are shown over time.

    Attributes:
        title: of all of them.
        unit: of the values.
        labels: one for each column.
        values: (n, columns).
        rotors: whether they are the speeds of four rotors.
    """

    title: str
    unit: str
    labels: tuple[str, ...]
    values: np.ndarray
    rotors: bool = False


@dataclasses.dataclass(frozen=True)
class Flight:
    """One flight.

    Attributes:
        name: shown next to the drone.
        time: (n,) s, rising.
        position: (n, 3) m, world.
        velocity: (n, 3) m/s, world.
        attitude: n rotations, body to world.
        strips: further signals.
        passages: (k, 3): time, s; index of the gate; distance from its edge, m, negative outside.
        lap_ends: (laps,) s.
        crash: why the flight ended early; "" where it did not.
        note: one line about the flight.
        periodic: whether it is a lap that can be repeated.
    """

    name: str
    time: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    attitude: Rotation
    strips: tuple[Strip, ...] = ()
    passages: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    lap_ends: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    crash: str = ""
    note: str = ""
    periodic: bool = False

    def repeated(self, times: int) -> "Flight":
        """A periodic flight several times in a row."""
        if not self.periodic or times < 2:
            return self
        lap = float(self.time[-1])
        shifts = lap * np.arange(times)

        def tile(values: np.ndarray) -> np.ndarray:
            return np.concatenate([values[:-1]] * (times - 1) + [values])

        passages = np.concatenate([self.passages + [shift, 0.0, 0.0] for shift in shifts])
        strips = tuple(dataclasses.replace(s, values=tile(s.values)) for s in self.strips)
        return dataclasses.replace(
            self,
            time=np.concatenate(
                [self.time[:-1] + x for x in shifts[:-1]] + [self.time + shifts[-1]]
            ),
            position=tile(self.position),
            velocity=tile(self.velocity),
            attitude=Rotation.from_quat(tile(self.attitude.as_quat())),
            strips=strips,
            passages=passages,
            lap_ends=np.concatenate([self.lap_ends + shift for shift in shifts]),
            note=f"{self.note}, repeated {times} times".lstrip(", "),
        )

    def resampled(self) -> "Flight":
        """The flight at ``RATE``, unless its samples are already about as dense."""
        steps = np.diff(self.time)
        if len(steps) < 1 or (steps.min() >= SHORTEST_STEP and steps.max() <= LONGEST_STEP):
            return self
        count = max(int(np.ceil(float(self.time[-1] - self.time[0]) * RATE)) + 1, 2)
        time = np.linspace(self.time[0], self.time[-1], count)
        path = CubicHermiteSpline(self.time, self.position, self.velocity)

        def linear(values: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(time, self.time, column) for column in values.T], axis=1)

        return dataclasses.replace(
            self,
            time=time,
            position=path(time),
            velocity=linear(self.velocity),
            attitude=Slerp(self.time, self.attitude)(time),
            strips=tuple(dataclasses.replace(s, values=linear(s.values)) for s in self.strips),
        )


@dataclasses.dataclass(frozen=True)
class Marker:
    """Lap times without a trajectory, for the time line: name, and ends of laps (laps,), s."""

    name: str
    lap_ends: np.ndarray

    def record(self) -> dict[str, str | list[float]]:
        """The marker as JSON takes it."""
        return {"name": self.name, "lap_ends": [round(float(end), 6) for end in self.lap_ends]}


def strip(title: str, unit: str, labels: Sequence[str], values: np.ndarray) -> Strip:
    """Signals of (n, columns); four of a unit of rotation are speeds of rotors."""
    return Strip(title, unit, tuple(labels), values, values.shape[1] == 4 and unit in TURNS)


def passages(
    time: np.ndarray,
    position: np.ndarray,
    gates: Sequence[Gate],
    target: np.ndarray | None = None,
) -> np.ndarray:
    """Where a flight passes the gates.

    Args:
        time: (n,) s.
        position: (n, 3) m, world.
        gates: of the track, in order of passage.
        target: (n,) index of the gate to pass next; None, or with a single gate: every passage
            through an opening, or at most ``REACH`` outside it, in the gate's direction.

    Returns:
        (k, 3): time, s; index of the gate; distance from the edge of its opening, m, negative
        outside. In order of time.
    """
    found, target = [], target if len(gates) > 1 else None
    for index, gate in enumerate(gates):
        local = (position - np.array(gate.position)) @ np.array(gate.axes)
        if target is None:
            (at,) = np.nonzero((local[:-1, 0] < 0) & (local[1:, 0] >= 0))
        else:
            (at,) = np.nonzero((target[:-1] == index) & (target[1:] != index))
        before, after = local[at], local[at + 1]
        fraction = -before[:, 0] / np.maximum(after[:, 0] - before[:, 0], 1e-12)
        fraction = np.clip(fraction, 0.0, 1.0)
        place = before + fraction[:, None] * (after - before)
        when = time[at] + fraction * (time[at + 1] - time[at])
        clear = clearance(gate, place[:, 1:])
        near = np.full(len(at), True) if target is not None else clear > -REACH
        found.append(np.stack([when, np.full(len(at), float(index)), clear], axis=1)[near])
    every = np.concatenate([*found, np.zeros((0, 3))])
    every = every[np.argsort(every[:, 0], kind="stable")]
    again = np.zeros(len(every), bool)  # a drone that hovers in a gate crosses its plane often
    again[1:] = (every[1:, 1] == every[:-1, 1]) & (target is None) & (len(gates) > 1)
    return every[~again]


def passages_at(
    time: np.ndarray, position: np.ndarray, gates: Sequence[Gate], when: np.ndarray
) -> np.ndarray:
    """As ``passages``, of a flight that passes the gates in order at known times (k,), s."""
    order = [index % len(gates) for index in range(len(when))]
    places = np.stack([np.interp(when, time, column) for column in position.T], axis=1)
    clear = [
        clearance(gates[index], ((place - gates[index].position) @ np.array(gates[index].axes))[1:])
        for index, place in zip(order, places, strict=True)
    ]
    return np.stack([when, np.array(order, float), np.array(clear)], axis=1)


def clearance(gate: Gate, place: np.ndarray) -> np.ndarray:
    """Distance (..) from the edge of a gate's opening, m, negative outside.

    Args:
        gate: the gate.
        place: (.., 2) along its width and its height, from its center, m.
    """
    if gate.shape == "circle":
        return 0.5 * gate.size[0] - np.linalg.norm(place, axis=-1)
    return (0.5 * np.array(gate.size) - np.abs(place)).min(axis=-1)
