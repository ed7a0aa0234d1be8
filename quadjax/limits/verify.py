"""Verification of a solution: simulation of its commands in the vehicle model."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.vectors import Vec3
from quadjax.limits.collocation import Trajectory
from quadjax.limits.guess import crossings, positions, simulate, velocities
from quadjax.limits.problem import Problem
from quadjax.race.rules import inside_frame

TIME_STEP = 1e-3  # s, for which each command is held
TIME_TOLERANCE = 0.005  # relative to the time of the solution
OVERRUN = 1.01  # the simulation is longer than the solution, to reach the last gate


@dataclasses.dataclass(frozen=True)
class Check:
    """The result of simulating a solution's commands: held for 1 ms, RK4, float64.

    Attributes:
        error: why the solution is rejected; "" if it is verified.
        leg_times: (legs,) s, between the gates.
        clearance: smallest distance from an edge of an opening, m; negative: outside.
        margin: smallest distance from the bounds and the ground, m; negative: outside.
        top_speed: m/s.
        closure: m, distance between the start and the end of a periodic flight.
    """

    error: str
    leg_times: np.ndarray
    clearance: float
    margin: float
    top_speed: float
    closure: float

    @property
    def total(self) -> float:
        """Time of the flight, s."""
        return float(self.leg_times.sum())


def verify(problem: Problem, trajectory: Trajectory, tolerance: float = 0.0) -> Check:
    """Simulate the commands of a solution and apply the rules.

    Args:
        problem: the flight.
        trajectory: the solution.
        tolerance: m, by which an edge of an opening may be missed.
    """
    total = trajectory.total
    middle = (np.arange(int(np.ceil(OVERRUN * total / TIME_STEP))) + 0.5) * TIME_STEP
    if problem.start == "periodic":
        middle %= total
    nodes = trajectory.times
    commands = np.stack([np.interp(middle, nodes, row) for row in trajectory.commands.T], axis=1)
    states = simulate(problem, commands, TIME_STEP, "rk4", trajectory.states[0])
    times, clearance = crossings(problem, states, TIME_STEP, problem.order, tolerance)
    if problem.clearance is None:
        clearance = 0.0 if len(times) == len(problem.order) else clearance
    last = round(times[-1] / TIME_STEP) if len(times) else 0
    margin = _margin(problem, states[: last + 1])
    flown = positions(problem, states)
    return Check(
        error=_error(problem, total, times, clearance, margin, tolerance),
        leg_times=np.diff(times, prepend=0.0),
        clearance=float(clearance),
        margin=margin,
        top_speed=float(np.linalg.norm(velocities(problem, states[: last + 1]), axis=1).max()),
        closure=float(np.linalg.norm(flown[last] - flown[0])),
    )


def _margin(problem: Problem, states: np.ndarray) -> float:
    """Smallest distance from the bounds, m; -inf where a rate, the pitch or a frame is hit."""
    flown = positions(problem, states)[1:]
    low, high = problem.bounds
    margin = min((flown - low).min(), (high - flown).min())
    with jax.enable_x64(True):
        tree = problem.state(jnp.asarray(states[1:]).T)
        rates = [np.abs(np.asarray(x)).max() for x in problem.model.rates(tree).components()]
        pitch = np.abs(np.asarray(problem.model.euler(tree).y)).max()
    inside = max(rates) <= problem.rate_limit * 1.001 and pitch <= problem.pitch_limit + 1e-3
    if problem.frame is not None:
        with jax.enable_x64(True):
            hit = jax.vmap(lambda place: inside_frame(place, problem.track, problem.frame, 0.0))
            inside &= not np.any(hit(Vec3.of(jnp.asarray(flown))))
    return float(margin) if inside and np.isfinite(states).all() else -np.inf


def _error(
    problem: Problem,
    claimed: float,
    times: np.ndarray,
    clearance: float,
    margin: float,
    tolerance: float,
) -> str:
    legs = len(problem.order)
    if clearance < -tolerance:
        return f"misses gate {problem.order[len(times)] + 1} by {-1e3 * clearance:.1f} mm"
    if len(times) < legs:
        return f"passes {len(times)} of {legs} gates"
    if margin < 0.0:
        return "leaves the bounds of the race"
    if abs(times[-1] - claimed) > TIME_TOLERANCE * claimed:
        return f"takes {times[-1]:.3f} s instead of {claimed:.3f} s"
    return ""
