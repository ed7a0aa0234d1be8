"""The trajectory of one run as NumPy arrays, for figures and animations."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.files import whole_file, write_npz
from quadjax.race.laps import Laps, Trace
from quadjax.race.track import GateSection
from quadjax.vehicle.protocol import Signal, VehicleModel

STATES = "quadjax-states/1"
SIGNALS = ("position", "velocity", "euler", "rates", "actuators", "command")


@dataclasses.dataclass(frozen=True)
class Recording:
    """The trajectory of one run, from its start to its end. World NED, body FRD."""

    time: np.ndarray  # (n,) s
    position: np.ndarray  # (n, 3) m, world
    velocity: np.ndarray  # (n, 3) m/s, world
    euler: np.ndarray  # (n, 3) roll, pitch, yaw, rad
    rates: np.ndarray  # (n, 3) rad/s, body
    actuators: np.ndarray  # (n, 4) propeller speeds, rpm, or (n, 1) specific thrust, m/s^2
    command: np.ndarray  # (n, 4) rpm, or rates, rad/s, and thrust, m/s^2
    target: np.ndarray  # (n,) index of the gate to pass next
    lap_ends: np.ndarray  # (completed laps,) s
    crash: str  # why the run ended early; "" where it did not

    @property
    def speed(self) -> np.ndarray:
        """Speed (n,), m/s."""
        return np.linalg.norm(self.velocity, axis=1)

    @property
    def motor_level(self) -> bool:
        """Whether the actuators are four propeller speeds, rather than one thrust."""
        return self.actuators.shape[1] == 4


def recordings(trace: Trace, laps: Laps, dt: float) -> list[Recording]:
    """The runs of a trace, each cut at its end.

    Args:
        trace: the recorded states.
        laps: the result of the same runs.
        dt: time step, s.
    """
    arrays = {name: np.asarray(getattr(trace, name), np.float64) for name in SIGNALS}
    result = []
    for run, crash in enumerate(laps.crashes):
        steps = arrays["position"].shape[0]
        end = min(int(round(laps.seconds[run] / dt)) + 1, steps)
        times = laps.lap_times[run]
        own = {name: array[:end, :, run] for name, array in arrays.items()}
        own["target"] = np.asarray(trace.target)[:end, run]
        ends = np.cumsum(times[np.isfinite(times)])
        result.append(Recording(dt * np.arange(end), **own, lap_ends=ends, crash=crash))
    return result


def state_arrays(flights: Sequence[Recording]) -> dict[str, np.ndarray]:
    """``time`` (steps,), and of all runs the signals (runs, steps, n) and ``target`` (runs, steps).

    NaN after a run's end.
    """
    time = max((flight.time for flight in flights), key=len)
    arrays = {"time": time}
    for name in (*SIGNALS, "target"):
        rows = [getattr(flight, name) for flight in flights]
        arrays[name] = np.full((len(rows), len(time), *rows[0].shape[1:]), np.nan)
        for whole, row in zip(arrays[name], rows, strict=True):
            whole[: len(row)] = row
    return arrays


def write_states(
    path: Path | str,
    flights: Sequence[Recording],
    laps: Laps,
    model: VehicleModel,
    gates: Sequence[GateSection],
    meta: dict[str, Any],
) -> None:
    """Write trajectories as arrays; see ``Evaluation.save_states``.

    Args:
        path: of the ``.npz`` file.
        flights: the runs.
        laps: of the same runs.
        model: the vehicle model.
        gates: of the track, in order of passage.
        meta: further entries of the metadata.
    """
    track = [gate.model_dump(mode="json") for gate in gates]
    known = {"format": STATES, "vehicle": model.name, "track": track}
    write_npz(path, state_arrays(flights) | {"lap_times": laps.lap_times}, meta | known)


def write_table(path: Path | str, flights: Sequence[Recording], model: VehicleModel) -> None:
    """Write trajectories as CSV: a line for each time of each run; the header has the units.

    Args:
        path: of the file.
        flights: the runs, numbered from 0.
        model: the vehicle model, which names actuators and commands.
    """
    names = [
        *(f"position_{axis} [m]" for axis in "xyz"),
        *(f"velocity_{axis} [m/s]" for axis in "xyz"),
        *(f"{angle} [rad]" for angle in ("roll", "pitch", "yaw")),
        *(f"rate_{axis} [rad/s]" for axis in "pqr"),
        *_columns("", (model.actuators,)),
        *_columns("command_", model.commands),
    ]
    rows = [
        np.column_stack(
            [
                np.full(len(flight.time), run),
                flight.time,
                flight.target,
                *(getattr(flight, name) for name in SIGNALS),
            ]
        )
        for run, flight in enumerate(flights)
    ]
    header = ",".join(["run", "time [s]", "target_gate", *names])
    with whole_file(path) as temporary:
        np.savetxt(temporary, np.concatenate(rows), "%.9g", ",", header=header, comments="")


def _columns(prefix: str, signals: Sequence[Signal]) -> list[str]:
    """Names and units of signals, numbered from 1 where a signal has several numbers."""
    return [
        f"{prefix}{signal.name}{'' if signal.size == 1 else f'_{index + 1}'} [{signal.unit}]"
        for signal in signals
        for index in range(signal.size)
    ]


def opening(flight: Recording, seconds: float) -> Recording:
    """The first seconds of a flight, or all of a shorter one."""
    count = int(np.searchsorted(flight.time, seconds + 1e-9))
    if count >= len(flight.time):
        return flight
    own = {name: getattr(flight, name)[:count] for name in ("time", "target", *SIGNALS)}
    return Recording(**own, lap_ends=flight.lap_ends[flight.lap_ends <= seconds], crash="")


def choose(flights: list[Recording]) -> Recording:
    """The fastest of the flights with the most laps, or else the longest."""
    return max(flights, key=lambda f: (len(f.lap_ends), -f.time[-1] if not f.crash else f.time[-1]))


def distinct(flights: list[Recording]) -> list[Recording]:
    """The flights without exact repetitions."""
    kept: list[Recording] = []
    for flight in flights:
        if not any(np.array_equal(flight.position, other.position) for other in kept):
            kept.append(flight)
    return kept


def gate_offsets(flight: Recording, gates: Sequence[GateSection]) -> np.ndarray:
    """Distance from the center of its gate of each passage of a flight (n,), m.

    The larger of the lateral and the vertical distance, where the straight line between two samples
    crosses the gate's plane.

    Args:
        flight: the trajectory.
        gates: of the track, in order of passage.
    """
    (time,) = np.nonzero(flight.target[1:] != flight.target[:-1])
    passed = [gates[index] for index in flight.target[time]]
    center = np.array([gate.position for gate in passed], np.float64).reshape(-1, 3)
    axes = np.array([gate.axes for gate in passed]).reshape(-1, 3, 3)
    before, after = (
        np.einsum("ni,nij->nj", position - center, axes)
        for position in (flight.position[time], flight.position[time + 1])
    )
    fraction = -before[:, 0] / np.maximum(after[:, 0] - before[:, 0], 1e-12)
    crossing = before + fraction[:, None] * (after - before)
    return np.abs(crossing[:, 1:]).max(axis=1)
