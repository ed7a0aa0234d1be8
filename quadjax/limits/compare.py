"""Comparison of two flights through the same gates: where one of them loses time."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, MUTED, SERIES, new_figure, tidy
from quadjax.limits.problem import Problem
from quadjax.limits.simulation import positions, vectors, velocities
from quadjax.limits.trajectory import Trajectory

POINTS = 50  # of a leg
MOST_NUMBERED = 24  # legs, up to which the gates have their numbers in the plots of the time lost


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A flight against the best known one, leg by leg.

    Attributes:
        best, flown: (legs,) s, the legs' times.
        length: (legs,) m, of the best known flight.
        distance: (points,) m, along the best known flight.
        lost: (points,) s, time lost up to that point. Within a leg, both flights are compared at
            equal fractions of their lengths.
    """

    best: np.ndarray
    flown: np.ndarray
    length: np.ndarray
    distance: np.ndarray
    lost: np.ndarray

    @property
    def gap(self) -> float:
        """How much longer the flight takes, relative to the best known one."""
        return float(self.flown.sum() / self.best.sum() - 1.0)

    @property
    def lost_per_meter(self) -> np.ndarray:
        """Time lost per meter of track (legs,), s/m."""
        return (self.flown - self.best) / self.length


def compare(problem: Problem, best: Trajectory, flown: Trajectory) -> Comparison:
    """Compare a flight with the best known one."""
    legs = len(best.leg_times)
    (length, ours), (_, theirs) = (_progress(problem, each) for each in (best, flown))
    shares = np.concatenate([np.arange(legs * POINTS) / POINTS, [legs]])
    lost = np.interp(shares, *theirs) - np.interp(shares, *ours)
    along = np.interp(shares, np.arange(legs + 1), np.concatenate([[0.0], np.cumsum(length)]))
    return Comparison(best.leg_times, flown.leg_times, length, along, lost)


def _progress(
    problem: Problem, trajectory: Trajectory
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Lengths of the legs, m; legs flown, as a fractional number, and the time, at the nodes."""
    place, count = positions(problem, trajectory.states), trajectory.intervals
    steps = np.linalg.norm(np.diff(place, axis=0), axis=1).reshape(-1, count)
    shares = np.cumsum(steps, axis=1) / steps.sum(axis=1, keepdims=True)
    flown = np.concatenate([[0.0], (shares + np.arange(len(steps))[:, None]).ravel()])
    return steps.sum(axis=1), (flown, trajectory.times)


def figure(problem: Problem, flights: dict[str, Trajectory]) -> Figure:
    """Path, speed, attitude and commands of flights by name; where one loses time to the other.

    The first flight is the best known one. The time lost is drawn if there are two.
    """
    whole = new_figure(11.0, 9.0)
    layout = whole.add_gridspec(4, 2, width_ratios=[1.1, 1.0])
    two = len(flights) > 1
    path = whole.add_subplot(layout[: 2 if two else 4, 0])
    axes = [whole.add_subplot(layout[row, 1]) for row in range(4)]
    for (name, flight), color in zip(flights.items(), SERIES, strict=False):
        _draw(problem, flight, (path, axes), color, f"{name}, {flight.total:.3f} s")
    _gates(problem, path)
    labels = ("speed [m/s]", "roll [deg]", "pitch [deg]", "commands")
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label, color=INK)
    axes[-1].set_xlabel("time [s]", color=INK)
    path.legend(frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    lost = [whole.add_subplot(layout[row, 0]) for row in (2, 3)] if two else []
    if two:
        compared = compare(problem, *list(flights.values())[:2])
        _draw_lost(compared, lost, problem.gate_count)
    for axis in (path, *lost, *axes):
        tidy(axis)
    _name_commands(problem, axes[-1])
    return whole


def _draw_lost(result: Comparison, axes: Sequence[Axes], gates: int) -> None:
    """The time lost along the best known flight, and per meter of it; gates have their numbers."""
    total, rate = axes
    total.plot(result.distance, 1e3 * result.lost, color=SERIES[1])
    total.set_ylabel("time lost [ms]", color=INK)
    steps = np.maximum(np.diff(result.distance), 1e-9)
    middle = 0.5 * (result.distance[1:] + result.distance[:-1])
    rate.plot(middle, 1e3 * np.diff(result.lost) / steps, color=SERIES[1])
    rate.set_ylabel("lost per meter [ms/m]", color=INK)
    rate.set_xlabel("distance along the best known flight [m]", color=INK)
    for axis in axes:
        axis.axhline(0.0, color=INK, linewidth=0.7)
        for gate in np.cumsum(result.length)[:-1]:
            axis.axvline(gate, color=MUTED, linewidth=0.7, linestyle=":")
    if len(result.length) <= MOST_NUMBERED:
        top = {"xycoords": total.get_xaxis_transform(), "ha": "center", "va": "bottom"}
        for index, gate in enumerate(np.cumsum(result.length)):
            total.annotate(str(index % gates + 1), (gate, 1.0), color=MUTED, **top)


def _draw(problem: Problem, flight: Trajectory, axes: tuple, color: str, label: str) -> None:
    path, (speed, roll, pitch, command) = axes
    place = positions(problem, flight.states)
    path.plot(place[:, 0], place[:, 1], color=color, label=label)
    time = flight.times
    speed.plot(time, np.linalg.norm(velocities(problem, flight.states), axis=1), color=color)
    angles = np.degrees(vectors(problem, flight.states, "euler"))
    for axis, column in ((roll, angles[:, 0]), (pitch, angles[:, 1])):
        turned = (column + 180.0) % 360.0 - 180.0
        jumps = np.flatnonzero(np.abs(np.diff(turned)) > 180.0) + 1
        axis.plot(np.insert(time, jumps, np.nan), np.insert(turned, jumps, np.nan), color=color)
    low, high = problem.command_range
    shares = (flight.commands - low) / np.where(high > low, high - low, 1.0)
    for index, row in enumerate(shares.T):
        command.plot(time, 0.1 + 0.8 * row - index, color=color, linewidth=0.9)


def _name_commands(problem: Problem, axis: Axes) -> None:
    """Names of the commands: each has a band of the axis, from its lowest to its highest."""
    names = []
    for signal in problem.model.commands:
        title = signal.name.replace("_", " ")
        numbers = range(1, signal.size + 1)
        names += [title] if signal.size == 1 else [f"{title} {number}" for number in numbers]
    axis.set_yticks(0.5 - np.arange(len(names)), names, fontsize="x-small")
    axis.set_ylim(1.0 - len(names), 1.0)
    for edge in range(len(names)):
        axis.axhline(-edge, color=MUTED, linewidth=0.5)


def _gates(problem: Problem, path: Axes) -> None:
    """Gates from above, numbered beyond their right ends; those at one place have one label."""
    gates, names = problem.gates, dict[tuple[float, ...], str]()
    places = [tuple(center[:2].round(1)) for center in gates.position]
    for index, place in enumerate(places):
        names[place] = f"{names[place]}, {index + 1}" if place in names else str(index + 1)
    for index, center in enumerate(gates.position):
        side = gates.axes[index, 1] * gates.half_size[index, 0]
        ends = np.stack([center - side, center + side])
        path.plot(ends[:, 0], ends[:, 1], color=INK, linewidth=2.5)
        away = 9.0 * gates.axes[index, 1, :2] * [1.0, -1.0]  # points; the axis of y is inverted
        if places.index(places[index]) < index:
            continue
        path.annotate(
            names[places[index]],
            ends[1, :2],
            xytext=away,
            textcoords="offset points",
            ha="center",
            va="center",
            color=MUTED,
        )
    path.set_aspect("equal")
    path.invert_yaxis()
    path.set_xlabel("x, north [m]", color=INK)
    path.set_ylabel("y, east [m]", color=INK)
