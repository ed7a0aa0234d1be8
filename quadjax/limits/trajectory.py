"""States and commands at the nodes of a mesh."""

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from quadjax.flights.flight import SIMULATED, Flight, Signal, motion_signals, vehicle_signals
from quadjax.flights.gates import passages_at
from quadjax.limits.problem import ACTUATORS, POSITION, RATES, VELOCITY, Problem, to_euler
from quadjax.race.track import GateSection
from quadjax.vehicle.protocol import VehicleModel


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """States and commands at the nodes of a mesh, with as many intervals in each leg."""

    leg_times: np.ndarray  # (legs,) s
    states: np.ndarray  # (nodes, 13 + actuators), as of ``Problem``
    commands: np.ndarray  # (nodes, commands)

    @property
    def intervals(self) -> int:
        """Intervals of a leg."""
        return (len(self.states) - 1) // len(self.leg_times)

    @property
    def total(self) -> float:
        """Duration, s."""
        return float(self.leg_times.sum())

    @property
    def times(self) -> np.ndarray:
        """Times of the nodes (nodes,), s."""
        steps = np.repeat(self.leg_times / self.intervals, self.intervals)
        return np.concatenate([[0.0], np.cumsum(steps)])

    def flight(
        self, name: str, model: VehicleModel, gates: Sequence[GateSection], **source: Any
    ) -> Flight:
        """The trajectory as a flight: a sample for each node, a passage at the end of each leg.

        Gates are those of the track, in order of passage; ``source`` has further facts.
        """
        x = self.states
        motion = x[:, POSITION], x[:, VELOCITY], to_euler(x), x[:, RATES]
        signals = motion_signals(dict(zip(SIMULATED, motion, strict=False)))
        when = np.cumsum(self.leg_times)
        legs = np.arange(len(x)) // self.intervals  # at its end the next one's gate is ahead
        target = Signal((legs % len(gates))[:, None].astype(np.float64))
        signals |= vehicle_signals(model, self.commands, x[:, ACTUATORS])
        return Flight(
            name=name,
            time=self.times,
            signals=signals | {"target": target},
            gates=tuple(gates),
            passages=passages_at(self.times, signals["position"].values, gates, when),
            lap_ends=when[len(gates) - 1 :: len(gates)],
            source={"vehicle": model.name, **source},
        )

    def curve(self, problem: Problem) -> CubicHermiteSpline:
        """The states as a function of time, with the slopes that the equations give."""
        with jax.enable_x64(True):
            slopes = np.asarray(jax.jit(jax.vmap(problem.slope))(self.states, self.commands))
        return CubicHermiteSpline(self.times, self.states, slopes)

    def resample(self, intervals: int, problem: Problem | None = None) -> "Trajectory":
        """The trajectory on another mesh, interpolated linearly.

        With a problem, the states are those that the collocation has between the nodes.
        """
        old = np.linspace(0, len(self.leg_times), len(self.states))
        new = np.linspace(0, len(self.leg_times), len(self.leg_times) * intervals + 1)
        states, commands = (
            np.stack([np.interp(new, old, column) for column in table.T], axis=1)
            for table in (self.states, self.commands)
        )
        mesh = Trajectory(self.leg_times, states, commands)
        if problem is None:
            return mesh
        return dataclasses.replace(mesh, states=self.curve(problem)(mesh.times))
