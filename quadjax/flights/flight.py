"""One flight: named signals over one time axis, and where it passes the gates."""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, Self

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from quadjax.flights.gates import passages
from quadjax.race.laps import Laps, Trace
from quadjax.race.track import GateSection
from quadjax.vehicle.protocol import VehicleModel

SAMPLE_RATE_HZ = 100.0  # of flights that are resampled
LONGEST_STEP_S, SHORTEST_STEP_S = 0.0201, 0.0079  # of flights about as dense as ``SAMPLE_RATE_HZ``
SINGLE_GATE_MARGIN_M = 0.3  # of openings on a track of one gate, which has no targets
AXES, ANGLES, RATES = ("x", "y", "z"), ("roll", "pitch", "yaw"), ("p, roll", "q, pitch", "r, yaw")
MOTORS = ("front left", "front right", "rear right", "rear left")
MOTION = {  # of every flight: unit and labels
    "position": ("m", AXES),
    "velocity": ("m/s", AXES),
    "attitude": ("rad", ANGLES),
    "rates": ("rad/s", RATES),
}
SIMULATED = (*MOTION, "actuators", "command")  # signals of a simulated flight


@dataclasses.dataclass(frozen=True)
class Signal:
    """Numbers over the time of a flight.

    Attributes:
        values: (n, k).
        unit: of all columns, or of each of the k columns; "" for none.
        labels: of the k columns; may be empty.
    """

    values: np.ndarray
    unit: str | tuple[str, ...] = ""
    labels: tuple[str, ...] = ()

    def by_unit(self) -> list["Signal"]:
        """The columns as signals of one unit each, in order."""
        if isinstance(self.unit, str):
            return [self]
        ends = [i for i in range(1, len(self.unit)) if self.unit[i] != self.unit[i - 1]]
        return [
            Signal(self.values[:, a:b], self.unit[a], self.labels[a:b])
            for a, b in zip([0, *ends], [*ends, len(self.unit)], strict=True)
        ]


@dataclasses.dataclass(frozen=True)
class Flight:
    """One flight of n samples. World NED, body FRD, SI units, rad.

    Attributes:
        name: of the flight.
        time: (n,) s, rising.
        signals: by name. Every flight has "position", m, and "velocity", m/s, world, and
            "attitude", roll, pitch and yaw, rad; others are "rates", rad/s, body, "actuators" and
            "command", in the units of the vehicle model, "target", the gate to pass next, and those
            of a flight log. NaN where a value is not known.
        gates: of the track, in order of passage; empty if they are not known.
        passages: (k, 3): time, s; index of the gate; distance from its edge, m, negative outside.
        lap_ends: (laps,) s, ends of the completed laps.
        crash: why the flight ended early; None where it did not.
        source: further facts, of the types of JSON: "vehicle", the name of the vehicle model;
            "constants", those of the model of a simulated drone, by name; "note", one line about
            the flight; "periodic", whether it is a lap that can be repeated.
    """

    name: str
    time: np.ndarray
    signals: dict[str, Signal]
    gates: tuple[GateSection, ...] = ()
    passages: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 3)))
    lap_ends: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0))
    crash: str | None = None
    source: dict[str, Any] = dataclasses.field(default_factory=dict)

    def __repr__(self) -> str:
        """One line, without the samples."""
        seconds = float(self.time[-1] - self.time[0]) if len(self.time) else 0.0
        counts = f"{len(self.time)} samples of {seconds:.2f} s, {len(self.passages)} gates passed"
        ended = f", {self.crash}" if self.crash else ""
        return f"Flight({self.name!r}: {counts}, {len(self.lap_ends)} laps{ended})"

    def __getitem__(self, name: str) -> np.ndarray:
        """The values (n, k) of a signal."""
        return self.signals[name].values

    @property
    def step(self) -> float:
        """Mean time between samples, s."""
        return float(self.time[-1] - self.time[0]) / (len(self.time) - 1)

    @property
    def sample_rate(self) -> float:
        """Mean number of samples per second, Hz."""
        return (len(self.time) - 1) / float(self.time[-1] - self.time[0])

    @property
    def speed(self) -> np.ndarray:
        """Speed (n,), m/s."""
        return np.linalg.norm(self["velocity"], axis=1)

    @property
    def flying(self) -> np.ndarray:
        """Whether in flight (n,) bool, by the signal "flying"; always without it."""
        if "flying" not in self.signals:
            return np.ones(len(self.time), bool)
        return self["flying"][:, 0] > 0.0

    @property
    def rotation(self) -> Rotation:
        """Attitudes, n rotations from body to world."""
        return Rotation.from_euler("ZYX", self["attitude"][:, ::-1])

    @property
    def target(self) -> np.ndarray:
        """Index (n,) of the gate to pass next: recorded, or else by the passages."""
        if "target" in self.signals:
            return self["target"][:, 0].astype(int)
        passed = np.searchsorted(self.passages[:, 0], self.time, side="right")
        return passed % max(len(self.gates), 1)

    @property
    def lap_times(self) -> np.ndarray:
        """Times of the completed laps (laps,), s."""
        return np.diff(self.lap_ends, prepend=0.0)

    @property
    def total(self) -> float:
        """Time of all laps, s; NaN where the flight ended early."""
        early = self.crash is not None or not len(self.lap_ends)
        return np.nan if early else float(self.lap_ends[-1])

    def replace(self, **changes: Any) -> Self:
        """The flight with other values of some attributes."""
        return dataclasses.replace(self, **changes)

    def of_drone(self, constants: Mapping[str, float]) -> Self:
        """The flight with the constants of the drone that flew, for its limits and lags."""
        return self.replace(source=self.source | {"constants": dict(constants)})

    def map(self, change: Callable[[np.ndarray], np.ndarray]) -> Self:
        """The flight with ``change`` applied to the values of every signal."""
        new = {k: dataclasses.replace(s, values=change(s.values)) for k, s in self.signals.items()}
        return self.replace(signals=new)

    def slice(self, rows: slice, from_zero: bool = False) -> Self:
        """Consecutive samples of the flight, and the passages and laps within their time.

        Args:
            rows: of the samples, without a step.
            from_zero: whether the first of them is at time 0.
        """
        time = self.time[rows]
        is_whole = len(time) > 0 and time[-1] == self.time[-1]
        first, last = (time[0], np.inf if is_whole else time[-1]) if len(time) else (0.0, -np.inf)
        passed = self.passages[(self.passages[:, 0] >= first) & (self.passages[:, 0] <= last)]
        ends = self.lap_ends[(self.lap_ends >= first) & (self.lap_ends <= last)]
        shift = first if from_zero else 0.0
        return self.map(lambda values: values[rows]).replace(
            time=time - shift,
            passages=passed - [shift, 0.0, 0.0],
            lap_ends=ends - shift,
            crash=self.crash if is_whole else None,
        )

    def opening(self, seconds: float) -> Self:
        """The first seconds of the flight, or all of a shorter one."""
        return self.slice(slice(0, int(np.searchsorted(self.time, seconds + 1e-9))))

    def airborne(self) -> Self:
        """From the first to the last sample in flight, from time 0; no sample without one."""
        (flying,) = np.nonzero(self.flying)
        rows = slice(int(flying[0]), int(flying[-1]) + 1) if len(flying) else slice(0, 0)
        return self.slice(rows, from_zero=True)

    def with_passages(
        self, gates: Sequence[GateSection], reach: float = 0.0, closed: bool = True
    ) -> Self:
        """The flight with the gates of a track, its passages through them, and its laps.

        Args:
            gates: in order of passage.
            reach: m by which openings are wider.
            closed: whether the first gate follows the last one.
        """
        passed = passages(self.time, self["position"], gates, reach=reach, closed=closed)
        ends = passed[len(gates) - 1 :: len(gates), 0] if gates else np.zeros(0)
        return self.replace(gates=tuple(gates), passages=passed, lap_ends=ends)

    def repeat(self, times: int) -> Self:
        """A periodic lap several times in a row; other flights do not change."""
        if not self.source.get("periodic") or times < 2:
            return self
        shifts = float(self.time[-1]) * np.arange(times)

        def tile(values: np.ndarray) -> np.ndarray:
            return np.concatenate([values[:-1]] * (times - 1) + [values])

        time = tile(self.time) + np.append(np.repeat(shifts, len(self.time) - 1), shifts[-1])
        note = f"{self.source.get('note', '')}, repeated {times} times".lstrip(", ")
        return self.map(tile).replace(
            time=time,
            passages=np.concatenate([self.passages + [shift, 0.0, 0.0] for shift in shifts]),
            lap_ends=np.concatenate([self.lap_ends + shift for shift in shifts]),
            source=self.source | {"note": note},
        )

    def resample(self, rate: float = SAMPLE_RATE_HZ) -> Self:
        """The flight at a rate, Hz, unless its samples are already about as dense.

        Positions follow the cubic curve of positions and velocities, attitudes the shortest turns,
        other signals straight lines.
        """
        from scipy.interpolate import CubicHermiteSpline  # takes long to import

        steps = np.diff(self.time) * rate / SAMPLE_RATE_HZ
        if len(steps) < 1 or (steps.min() >= SHORTEST_STEP_S and steps.max() <= LONGEST_STEP_S):
            return self
        count = max(int(np.ceil(float(self.time[-1] - self.time[0]) * rate)) + 1, 2)
        time = np.linspace(self.time[0], self.time[-1], count)
        path = CubicHermiteSpline(self.time, self["position"], self["velocity"])
        turns = Slerp(self.time, self.rotation)(time)

        def linear(values: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(time, self.time, column) for column in values.T], axis=1)

        flight = self.map(linear).replace(time=time)
        angles = turns.as_euler("ZYX")[:, ::-1]
        return flight.with_signals(position=path(time), attitude=angles)

    def with_signals(self, **values: np.ndarray) -> Self:
        """The flight with other values (n, k) of signals that it has."""
        new = {k: dataclasses.replace(self.signals[k], values=v) for k, v in values.items()}
        return self.replace(signals=self.signals | new)


def fastest(flights: Iterable[Flight]) -> Flight:
    """The flight with the most laps, and the fastest of those; without a lap the longest."""

    def order(flight: Flight) -> tuple[float, float, float]:
        ends = flight.lap_ends
        return (-len(ends), float(ends[-1]) if len(ends) else 0.0, -float(flight.time[-1]))

    return min(flights, key=order)


def distinct(flights: Iterable[Flight]) -> list[Flight]:
    """The flights without exact repetitions."""
    kept: list[Flight] = []
    for flight in flights:
        if not any(np.array_equal(flight["position"], other["position"]) for other in kept):
            kept.append(flight)
    return kept


def numbered(name: str, count: int) -> list[str]:
    """The names of several flights: ``name`` with numbers from 1; of one flight without."""
    return [name] if count == 1 else [f"{name} {number}" for number in range(1, count + 1)]


def motion_signals(arrays: Mapping[str, np.ndarray]) -> dict[str, Signal]:
    """Signals of the rigid body from arrays (n, 3) by name; those of ``MOTION``."""
    return {
        name: Signal(arrays[name], unit, labels)
        for name, (unit, labels) in MOTION.items()
        if name in arrays
    }


def vehicle_signals(
    model: VehicleModel | None, command: np.ndarray, actuators: np.ndarray
) -> dict[str, Signal]:
    """The signals "command" and "actuators" (n, k) of a vehicle model; None: of unknown units."""
    if model is None:
        return {"command": Signal(command), "actuators": Signal(actuators)}
    units: list[str] = []
    labels: list[str] = []
    for command_signal in model.commands:
        units += [command_signal.unit] * command_signal.size
        labels += _labels(command_signal.name, command_signal.size)
    unit = units[0] if len(set(units)) == 1 else tuple(units)
    state = model.actuators
    return {
        "command": Signal(command, unit, tuple(labels)),
        "actuators": Signal(actuators, state.unit, tuple(_labels(state.name, state.size))),
    }


def _labels(name: str, size: int) -> Sequence[str]:
    if size == 1:
        return (name.replace("_", " "),)
    return {4: MOTORS, 3: RATES}.get(size) or [str(index + 1) for index in range(size)]


def recorded_flights(
    trace: Trace,
    laps: Laps,
    time_step: float,
    gates: Sequence[GateSection],
    model: VehicleModel,
    name: str = "run",
) -> list[Flight]:
    """The runs of a simulation, each cut at its end; several are numbered from 1.

    Args:
        trace: the recorded states.
        laps: the result of the same runs.
        time_step: s.
        gates: of the track, in order of passage.
        model: of the vehicle.
        name: of a flight.
    """
    names = {"attitude": "euler"}
    arrays = {key: np.asarray(getattr(trace, names.get(key, key)), np.float64) for key in SIMULATED}
    flights, labels = [], numbered(name, len(laps.crashes))
    for run, crash in enumerate(laps.crashes):
        steps = len(arrays["position"])
        end = min(int(round(laps.seconds[run] / time_step)) + 1, steps)
        values = {key: array[:end, :, run] for key, array in arrays.items()}
        values["target"] = np.asarray(trace.target)[:end, run, None].astype(np.float64)
        more = (gates, model, laps.lap_times[run], crash)
        flights.append(simulated_flight(labels[run], time_step, values, *more, cut=False))
    return flights


def simulated_flight(
    name: str,
    time_step: float,
    values: Mapping[str, np.ndarray],
    gates: Sequence[GateSection],
    model: VehicleModel,
    lap_times: np.ndarray,
    crash: str,
    cut: bool = True,
) -> Flight:
    """A simulated flight from its start to its end.

    Args:
        name: of the flight.
        time_step: between samples, s.
        values: (n, k) of the signals ``SIMULATED`` and "target".
        gates: of the track, in order of passage.
        model: of the vehicle.
        lap_times: (laps,) s, by the rules of the race; NaN where not completed.
        crash: why it ended early; "" where it did not.
        cut: whether the state at the end of the last step is missing.
    """
    time = time_step * np.arange(len(values["position"]))
    target = values["target"]
    signals = motion_signals(values)
    signals |= vehicle_signals(model, values["command"], values["actuators"])
    passed = passages(
        time,
        values["position"],
        gates,
        reach=SINGLE_GATE_MARGIN_M if len(gates) == 1 else 0.0,
        target=target[:, 0],
        cut=cut and not crash,
    )
    return Flight(
        name=name,
        time=time,
        signals=signals | {"target": Signal(target)},
        gates=tuple(gates),
        passages=passed,
        lap_ends=np.cumsum(lap_times[np.isfinite(lap_times)]),
        crash=crash or None,
        source={"vehicle": model.name},
    )
