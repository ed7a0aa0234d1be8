"""Verification of a solution: simulation of its commands in the vehicle model."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.vectors import Vec3
from quadjax.limits.problem import Problem
from quadjax.limits.rules import Wall
from quadjax.limits.simulation import crossings, positions, simulate, vectors, velocities
from quadjax.limits.tracking import follow, reference
from quadjax.limits.trajectory import Trajectory
from quadjax.race.rules import inside_frame

TIME_STEP = 1e-3  # s, for which each command is held
TIME_TOLERANCE = 0.005  # relative to the time of the solution
STEPS = 1000  # the number of steps is a multiple: each number is compiled anew
OVERRUN = 1.01  # the simulation is longer than the solution, to reach the last gate
AT_REST = 0.02, 0.05  # m from the center of the last gate, and m/s, at the end of a flight at rest
NEAR_GATE = 0.1  # legs from a gate, within which its own frame is that of the passage
RATE_TOLERANCE, PITCH_TOLERANCE = 1.001, 1e-3  # a factor, and rad


@dataclasses.dataclass(frozen=True)
class Check:
    """The result of simulating a solution: commands held for 1 ms, RK4, float64.

    Attributes:
        error: why the solution is rejected; "" if it is verified.
        leg_times: (legs,) s, between the gates.
        clearance: smallest ``Problem.leeway``, m, or depth in the frame of a gate that is passed;
            negative where a gate is missed or its frame is hit.
        margin: smallest distance from the bounds and the ground, m; negative: outside.
        top_speed: m/s.
        closure: m, distance between the start and the end of a periodic flight.
        feedback: whether a regulator corrected the solution's commands.
        states: (steps + 1, leaves) of the simulation.
        commands: (steps, commands) that it flew.
        rates: (3,) rad/s, largest body rates.
        walls: sides of frames that a flight that hit them should keep to.
    """

    error: str
    leg_times: np.ndarray
    clearance: float
    margin: float
    top_speed: float
    closure: float
    feedback: bool
    states: np.ndarray
    commands: np.ndarray
    rates: np.ndarray
    walls: tuple[Wall, ...] = ()

    @property
    def total(self) -> float:
        """Time of the flight, s."""
        return float(self.leg_times.sum())

    @property
    def drift(self) -> float:
        """By how much the flight leaves the openings and the bounds, m; inf if it fails."""
        return max(0.0, -min(self.clearance, self.margin), 5e-4 * bool(self.error))


def verify(problem: Problem, trajectory: Trajectory, tolerance: float = 0.0) -> Check:
    """Simulate the commands of a solution and apply the rules.

    The commands are flown as they are; if this flight is rejected, also with a regulator that
    corrects them.

    Args:
        problem: the flight.
        trajectory: the solution.
        tolerance: m, by which an edge of an opening may be missed.
    """
    steps = STEPS * int(np.ceil(OVERRUN * trajectory.total / (STEPS * TIME_STEP)))
    _, commands = reference(problem, trajectory, TIME_STEP, steps)
    states = simulate(problem, commands, TIME_STEP, "rk4", trajectory.states[0])
    check = _check(problem, trajectory, states, commands, tolerance, False)
    if not check.drift and not check.error:
        return check
    states, commands = follow(problem, trajectory, TIME_STEP, steps)
    corrected = _check(problem, trajectory, states, commands, tolerance, True)
    better = (bool(corrected.error), corrected.drift) < (bool(check.error), check.drift)
    return corrected if better else check


def _check(
    problem: Problem,
    trajectory: Trajectory,
    states: np.ndarray,
    commands: np.ndarray,
    tolerance: float,
    feedback: bool,
) -> Check:
    flown = positions(problem, states)
    order = problem.order[:-1] if problem.stops else problem.order
    times, clearance = crossings(problem, flown, TIME_STEP, order, tolerance)
    if problem.stops and len(times) == len(order):
        times = np.append(times, trajectory.total)
    last = min(round(times[-1] / TIME_STEP), len(flown) - 1) if len(times) else 0
    margin, error = _margin(problem, states[: last + 1], tolerance)
    frame_clearance, walls = frames_hit(problem, positions(problem, states[1 : last + 1]), times)
    clearance = min(clearance, frame_clearance)
    if walls and not error:
        error = "hits the frame of a gate"
    if problem.stops and not error and len(times) == len(problem.order):
        error = _at_rest(problem, states[last])
    error = _error(problem, trajectory.total, times, clearance, margin, tolerance) or error
    return Check(
        error=error,
        leg_times=np.diff(times, prepend=0.0),
        clearance=float(min(clearance, 1e3)),
        margin=margin,
        top_speed=float(np.linalg.norm(velocities(problem, states[: last + 1]), axis=1).max()),
        closure=float(np.linalg.norm(flown[last] - flown[0])),
        feedback=feedback,
        states=states[: last + 1],
        commands=commands[:last],
        rates=np.abs(vectors(problem, states[: last + 1], "rates")).max(axis=0),
        walls=walls,
    )


def _at_rest(problem: Problem, state: np.ndarray) -> str:
    place = positions(problem, state[None])[0] - problem.gates.position[problem.order[-1]]
    speed = np.linalg.norm(velocities(problem, state[None]))
    if np.linalg.norm(place) > AT_REST[0] or speed > AT_REST[1]:
        return f"ends {np.linalg.norm(place):.3f} m from the last gate at {speed:.2f} m/s"
    return ""


def _margin(problem: Problem, states: np.ndarray, tolerance: float) -> tuple[float, str]:
    """Smallest distance from the bounds and, in fast flight, the ground, m; and what else fails."""
    flown = positions(problem, states)[1:]
    low, high = problem.bounds
    margin = float(min((flown - low).min(initial=np.inf), (high - flown).min(initial=np.inf)))
    if not np.isfinite(states).all():
        return -np.inf, "leaves the bounds of the race"
    if np.linalg.norm(velocities(problem, states), axis=1).max() > problem.speed_rule:
        return margin, "exceeds the speed limit"
    rates = np.abs(vectors(problem, states, "rates")).max(axis=0)
    if np.any(rates > problem.rate_limit * RATE_TOLERANCE):
        return margin, "exceeds the limit of the body rates"
    if (
        np.abs(vectors(problem, states, "euler")[:, 1]).max()
        > problem.pitch_limit + PITCH_TOLERANCE
    ):
        return margin, "exceeds the limit of the pitch"
    if problem.landing is not None:
        fast = np.linalg.norm(velocities(problem, states)[1:], axis=1) > float(
            problem.landing.speed
        )
        height = float(-flown[fast, 2].max(initial=-np.inf) - problem.landing.height)
        margin = min(margin, height)
        if height < -tolerance:
            return margin, "flies too fast near the ground"
    return margin, ""


def frames_hit(
    problem: Problem, flown: np.ndarray, times: np.ndarray
) -> tuple[float, tuple[Wall, ...]]:
    """Where a flight is inside solid frames.

    Returns:
        The smallest distance, m, from the inner edges of the frames of the gates that it passes,
        negative inside, inf if it is inside none; and for each part inside the frame of another
        gate, the nearest outer side.
    """
    clearance, walls = np.inf, []
    if problem.frame is None:
        return clearance, ()
    with jax.enable_x64(True):
        hit = jax.vmap(
            lambda p: inside_frame(p, problem.track, problem.frame, 0.0, problem.radius)
        )(Vec3.of(jnp.asarray(flown)))
    nodes = np.concatenate([[0.0], times])
    (found,) = np.nonzero(np.asarray(hit))
    for part in np.split(found, np.flatnonzero(np.diff(found) > 1) + 1) if len(found) else ():
        legs = np.interp(TIME_STEP * (part[[0, -1]] + 1), nodes, np.arange(len(nodes)))
        gate, local = _nearest_frame(problem, flown[part])
        passed = round(legs.mean())
        if abs(legs.mean() - passed) < NEAR_GATE and problem.order[passed - 1] == gate:
            own = [problem.gates.clearance(gate, place) for place in flown[part]]
            clearance = min(clearance, *own)
        else:
            walls.append(_wall(problem, gate, local, legs))
    return clearance, tuple(walls)


def _nearest_frame(problem: Problem, places: np.ndarray) -> tuple[int, np.ndarray]:
    """The gate whose frame is nearest to places (n, 3), and these in its axes (n, 3), m."""
    offset = places[:, None] - problem.gates.position  # (n, gates, 3)
    local = np.einsum("gij,ngj->ngi", problem.gates.axes, offset)
    gate = int(np.argmin(np.abs(local[:, :, 0]).max(axis=0) + np.abs(local).max(axis=(0, 2))))
    return gate, local[:, gate]


def _wall(problem: Problem, gate: int, local: np.ndarray, legs: np.ndarray) -> Wall:
    """The outer side of a frame that is nearest to places (n, 3) in the gate's axes, m."""
    wider = float(problem.frame.width) + 2.0 * problem.radius  # than the opening for a point
    size = problem.gates.half_size[gate] + wider
    axis = 1 + int(np.argmin(size - np.abs(local[:, 1:]).max(axis=0)))
    sign = float(np.sign(local[:, axis].mean()))
    return Wall((legs[0] - 0.1, legs[1] + 0.1), gate, axis, sign, float(size[axis - 1]))


def _error(
    problem: Problem,
    claimed: float,
    times: np.ndarray,
    clearance: float,
    margin: float,
    tolerance: float,
) -> str:
    legs = len(problem.order)
    if clearance < -tolerance and len(times) == legs:
        return "hits the frame of a gate"
    if clearance < -tolerance:
        return f"misses gate {problem.order[len(times)] + 1} by {-1e3 * clearance:.1f} mm"
    if len(times) < legs:
        return f"passes {len(times)} of {legs} gates"
    if margin < -tolerance:
        return "leaves the bounds of the race"
    if abs(times[-1] - claimed) > TIME_TOLERANCE * claimed:
        return f"takes {times[-1]:.3f} s instead of {claimed:.3f} s"
    return ""
