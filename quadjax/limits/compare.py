"""Comparison of two flights through the same gates: where one of them loses time."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, MUTED, SERIES, head, new_figure, tidy
from quadjax.evaluation.figures import draw_gates
from quadjax.limits.problem import POSITION, VELOCITY, Problem, euler_of
from quadjax.limits.trajectory import Trajectory
from quadjax.race.track import GateSection

POINTS = 50  # of a leg


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A flight against the best known one, leg by leg.

    Within a leg, both flights are compared at equal fractions of their lengths.
    """

    best: np.ndarray  # (legs,) s, the legs' times
    flown: np.ndarray  # (legs,) s
    length: np.ndarray  # (legs,) m, of the best known flight
    distance: np.ndarray  # (points,) m, along the best known flight
    lost: np.ndarray  # (points,) s, time lost up to that point

    @property
    def gap(self) -> float:
        """How much longer the flight takes, relative to the best known one."""
        return float(self.flown.sum() / self.best.sum() - 1.0)

    @property
    def lost_per_meter(self) -> np.ndarray:
        """Time lost per meter of track (legs,), s/m."""
        return (self.flown - self.best) / self.length

    def table(self, name: str) -> str:
        """The times of the legs as text; ``name`` is that of the policy."""
        lines = [
            f"{name}: {self.flown.sum():.4f} s, {100 * self.gap:.1f}% above best known",
            f"{'leg':>5} {'best known':>11} {'policy':>8} {'lost':>8} {'lost per meter':>15}",
        ]
        rows = zip(self.best, self.flown, self.lost_per_meter, strict=True)
        lines += [
            f"{leg:>5} {ours:>9.3f} s {theirs:>6.3f} s {theirs - ours:>6.3f} s "
            f"{1e3 * per_meter:>10.1f} ms/m"
            for leg, (ours, theirs, per_meter) in enumerate(rows, 1)
        ]
        return "\n".join(lines)

    def to_json(self) -> dict[str, Any]:
        """The times of the policy's legs, s, the gap, and the time lost per meter, s/m."""
        lost = self.lost_per_meter.tolist()
        return {"leg_times": self.flown.tolist(), "gap": self.gap, "lost_per_meter": lost}


def compare(best: Trajectory, flown: Trajectory) -> Comparison:
    """Compare a flight with the best known one."""
    legs, (length, ours), (_, theirs) = len(best.leg_times), _progress(best), _progress(flown)
    points = np.linspace(0.0, legs, legs * POINTS + 1)
    lost = np.interp(points, theirs, flown.times) - np.interp(points, ours, best.times)
    along = np.interp(points, np.arange(legs + 1), np.cumsum([0.0, *length]))
    return Comparison(best.leg_times, flown.leg_times, length, along, lost)


def _progress(flight: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of the legs, m, and the legs flown at the nodes, as a fractional number."""
    steps = np.linalg.norm(np.diff(flight.states[:, POSITION], axis=0), axis=1)
    legs = steps.reshape(-1, flight.intervals)
    fractions = legs / legs.sum(axis=1, keepdims=True)
    return legs.sum(axis=1), np.cumsum([0.0, *fractions.ravel()])


def flights_figure(
    problem: Problem, gates: Sequence[GateSection], flights: dict[str, Trajectory]
) -> Figure:
    """Path, speed, attitude and commands of flights by name; where one loses time to the other.

    The first flight is the best known one. The time lost is drawn if there are two.
    """
    whole, two = new_figure(11.0, 9.0), len(flights) > 1
    layout = whole.add_gridspec(4, 2, width_ratios=[1.1, 1.0])
    path = whole.add_subplot(layout[: 3 if two else 4, 0], aspect="equal")
    axes = [whole.add_subplot(layout[row, 1]) for row in range(4)]
    for (name, flight), color in zip(flights.items(), SERIES, strict=False):
        label, (x, y, _) = f"{name}, {flight.total:.3f} s", flight.states[:, POSITION].T
        path.plot(x, y, color=color, label=label)
        _draw(problem, flight, axes, color)
    reach = 0.055 * float(np.ptp([gate.position for gate in gates], axis=0).max())
    draw_gates(path, gates, reach)
    path.margins(0.12)  # for the numbers of the gates
    path.invert_yaxis()
    path.set(xlabel="x, north (m)", ylabel="y, east (m)")
    labels = ("speed (m/s)", "roll (deg)", "pitch (deg)", "commands")
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label)
    axes[-1].set_xlabel("time (s)")
    if two:
        result, axis = compare(*list(flights.values())[:2]), whole.add_subplot(layout[3, 0])
        axis.plot(result.distance, 1e3 * result.lost, color=SERIES[1])
        axis.set(xlabel="distance along the best known flight (m)", ylabel="time lost (ms)")
        for end in np.cumsum(result.length)[:-1]:
            axis.axvline(end, color=MUTED, linewidth=0.7, linestyle=":")
    for axis in whole.axes:
        tidy(axis)
        axis.xaxis.label.set_color(INK)
        axis.yaxis.label.set_color(INK)
    head(path, columns=2)
    signals = [(signal[0].replace("_", " "), signal[1]) for signal in problem.model.commands]
    names = [f"{name} {i + 1}" if n > 1 else name for name, n in signals for i in range(n)]
    axes[-1].set_yticks(0.5 - np.arange(len(names)), names, fontsize="x-small")
    return whole


def _draw(problem: Problem, flight: Trajectory, axes: Sequence[Axes], color: str) -> None:
    """Speed, roll and pitch, and the commands: each in a band, from its lowest to its highest."""
    speed, *angles, command = axes
    speed.plot(flight.times, np.linalg.norm(flight.states[:, VELOCITY], axis=1), color=color)
    for axis, angle in zip(angles, np.degrees(euler_of(flight.states)).T, strict=False):
        jumps = np.flatnonzero(np.abs(np.diff(angle)) > 180.0) + 1
        times = np.insert(flight.times, jumps, np.nan)
        axis.plot(times, np.insert(angle, jumps, np.nan), color=color)
    low, high = problem.command_range
    fractions = (flight.commands - low) / np.where(high > low, high - low, 1.0)
    for index, row in enumerate(fractions.T):
        command.plot(flight.times, 0.1 + 0.8 * row - index, color=color, linewidth=0.9)
