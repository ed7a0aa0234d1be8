"""States and commands at the nodes of a mesh."""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class Trajectory:
    """States and commands at the nodes of a mesh, with as many intervals in each leg."""

    leg_times: np.ndarray  # (legs,) s
    states: np.ndarray  # (nodes, state leaves)
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

    def resample(self, intervals: int) -> "Trajectory":
        """The trajectory on another mesh, interpolated linearly."""
        old = np.linspace(0, len(self.leg_times), len(self.states))
        new = np.linspace(0, len(self.leg_times), len(self.leg_times) * intervals + 1)
        columns = (
            np.stack([np.interp(new, old, column) for column in table.T], axis=1)
            for table in (self.states, self.commands)
        )
        return Trajectory(self.leg_times, *columns)
