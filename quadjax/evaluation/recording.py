"""The trajectory of one run as NumPy arrays, for figures and animations."""

import dataclasses

import numpy as np

from quadjax.race.laps import Laps, Trace

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
        ends = np.cumsum(times[np.isfinite(times)])
        result.append(Recording(dt * np.arange(end), **own, lap_ends=ends, crash=crash))
    return result


def opening(flight: Recording, seconds: float) -> Recording:
    """The first seconds of a flight, or all of a shorter one."""
    count = int(np.searchsorted(flight.time, seconds + 1e-9))
    if count >= len(flight.time):
        return flight
    own = {name: getattr(flight, name)[:count] for name in ("time", *SIGNALS)}
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
