"""Comparison of two flights through the same gates: where one of them loses time."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, MUTED, SERIES, new_figure, tidy
from quadjax.limits.collocation import Trajectory
from quadjax.limits.guess import positions, velocities
from quadjax.limits.problem import Problem

POINTS = 50  # of a leg


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
    """Path, speed, attitude and commands of flights by name; time lost, of two flights.

    The first flight is the best known one.
    """
    whole = new_figure(11.0, 9.0)
    layout = whole.add_gridspec(4, 2, width_ratios=[1.1, 1.0])
    path = whole.add_subplot(layout[:3, 0])
    axes = [whole.add_subplot(layout[row, 1]) for row in range(4)]
    lost = whole.add_subplot(layout[3, 0])
    for (name, flight), color in zip(flights.items(), SERIES, strict=False):
        _draw(problem, flight, (path, axes), color, f"{name}, {flight.total:.3f} s")
    _gates(problem, path)
    labels = ("speed [m/s]", "roll [deg]", "pitch [deg]", "commands, fraction of range")
    for axis, label in zip(axes, labels, strict=True):
        axis.set_ylabel(label, color=INK)
    axes[-1].set_xlabel("time [s]", color=INK)
    path.legend(frameon=False)
    if len(flights) > 1:
        result = compare(problem, *list(flights.values())[:2])
        lost.plot(result.distance, result.lost, color=SERIES[1])
    lost.set_xlabel("distance along the best known flight [m]", color=INK)
    lost.set_ylabel("time lost [s]", color=INK)
    for axis in (path, lost, *axes):
        tidy(axis)
    return whole


def _draw(problem: Problem, flight: Trajectory, axes: tuple, color: str, label: str) -> None:
    path, (speed, roll, pitch, command) = axes
    place = positions(problem, flight.states)
    path.plot(place[:, 0], place[:, 1], color=color, label=label)
    time = flight.times
    speed.plot(time, np.linalg.norm(velocities(problem, flight.states), axis=1), color=color)
    with jax.enable_x64(True):
        euler = problem.model.euler(problem.state(jnp.asarray(flight.states).T))
        angles = [np.degrees(np.asarray(x)) for x in (euler.x, euler.y)]
    roll.plot(time, (angles[0] + 180.0) % 360.0 - 180.0, color=color)
    pitch.plot(time, angles[1], color=color)
    low, high = problem.command_range
    shares = (flight.commands - low) / np.where(high > low, high - low, 1.0)
    for index, row in enumerate(shares.T):
        style = ("-", "--", "-.", ":")[index % 4]
        command.plot(time, row, color=color, linewidth=0.9, linestyle=style)


def _gates(problem: Problem, path: object) -> None:
    gates = problem.gates
    for index, center in enumerate(gates.position):
        side = gates.right[index] * gates.half_size[index, 0]
        ends = np.stack([center - side, center + side])
        path.plot(ends[:, 0], ends[:, 1], color=INK, linewidth=2.5)
        path.annotate(str(index + 1), center[:2], color=MUTED)
    path.set_aspect("equal")
    path.invert_yaxis()
    path.set_xlabel("x, north [m]", color=INK)
    path.set_ylabel("y, east [m]", color=INK)
