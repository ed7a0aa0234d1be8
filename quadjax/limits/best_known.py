"""The result of a search: a verified flight, what was tried, and remarks; or why there is none."""

import dataclasses

import numpy as np

from quadjax.limits.problem import Problem
from quadjax.limits.simulation import velocities
from quadjax.limits.trajectory import Trajectory
from quadjax.limits.verify import TIME_STEP, Check

SAME = 1e-3  # relative change of the time below which the mesh is fine enough


@dataclasses.dataclass(frozen=True)
class Attempt:
    """The result from one initial guess."""

    guess: str
    time: float | None  # s, None where the solver did not converge
    status: str


@dataclasses.dataclass(frozen=True)
class BestKnown:
    """A verified flight. Its time is an upper bound of the shortest time; it may not be optimal.

    Attributes:
        trajectory: states and commands at the nodes.
        check: the flight by the commands.
        guess: where the solver started.
        margin: m, kept from the edges of the openings and the bounds.
        mesh_change: relative change of the time between the last two meshes.
        attempts: one for each initial guess.
        seconds: processor time.
        notes: remarks on the result, one sentence each.
    """

    trajectory: Trajectory
    check: Check
    guess: str
    margin: float
    mesh_change: float
    attempts: tuple[Attempt, ...]
    seconds: float
    notes: tuple[str, ...]

    @property
    def total(self) -> float:
        """Time, s: the longer of the solution's and of the flight by its commands."""
        return max(self.trajectory.total, self.check.total)


@dataclasses.dataclass(frozen=True)
class Unverified:
    """A solution that is not verified.

    Attributes:
        trajectory: states and commands at the nodes.
        guess: where the solver started.
        reserve: fraction of the commands' ranges that it does not use.
        error: why it is rejected.
    """

    trajectory: Trajectory
    guess: str
    reserve: float
    error: str


class NotFoundError(Exception):
    """No initial guess led to a verified flight: one line that says what was tried.

    Attributes:
        unverified: the last solution, or None.
    """

    def __init__(self, tried: str, unverified: Unverified | None = None) -> None:
        """Say what was tried, and what the last solution is."""
        self.unverified = unverified
        text = f"no flight was found ({tried or 'no time'}); try more time (--seconds)"
        if unverified is not None:
            found = unverified.trajectory
            text += (
                f"; a solution of {found.total:.3f} s with {found.intervals} intervals a leg and "
                f"a reserve of {100.0 * unverified.reserve:g}% of the commands is not verified: "
                f"{unverified.error}"
            )
        super().__init__(text)


def notes_on(problem: Problem, best: BestKnown) -> tuple[str, ...]:
    """Remarks on a result, one sentence each."""
    notes = []
    if best.check.top_speed > 0.99 * problem.speed_limit:
        notes.append(
            f"the flight reaches the speed limit of {problem.speed_limit:g} m/s; the "
            "vehicle model may not hold there"
        )
    fitted, speeds = problem.fitted_speed, velocities(problem, best.check.states)
    above = TIME_STEP * np.sum(np.linalg.norm(speeds, axis=1) > fitted)
    if above > 0.0:
        notes.append(
            f"for {above:.2f} s the flight is faster than {fitted:g} m/s, the highest speed of "
            "the flights that the model is fitted to"
        )
    if best.mesh_change > SAME:
        notes.append("the mesh was not refined until the time converged")
    return tuple(notes)
