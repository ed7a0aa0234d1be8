"""States and commands at the nodes of a mesh."""

import dataclasses

import jax
import numpy as np
from scipy.interpolate import CubicHermiteSpline

from quadjax.evaluation.recording import SIGNALS
from quadjax.limits.problem import ACTUATORS, POSITION, RATES, VELOCITY, Problem, euler_of


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

    def arrays(self) -> dict[str, np.ndarray]:
        """The flight as a file has it: times, s, signals by name with Euler angles, leg times."""
        x = self.states
        motion = x[:, POSITION], x[:, VELOCITY], euler_of(x), x[:, RATES], x[:, ACTUATORS]
        signals = dict(zip(SIGNALS, (*motion, self.commands), strict=True))
        return {"time": self.times, **signals, "leg_times": self.leg_times}

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
