"""The time-optimal flight of a point mass with limited force and jerk, for initial guesses.

It has neither attitude nor actuators, so the solver finds it quickly from a spline.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from quadjax.limits.problem import ACTUATORS, POSITION, VELOCITY, Problem
from quadjax.limits.program import Effort, add_rules, bound, minimize
from quadjax.limits.translate import casadi

USED_FORCE = 0.9  # fraction of the largest thrust; the rest is left for control
TILTING = 10.0  # rad/s, jerk relative to the largest force
UPRIGHT = 0.15  # smallest vertical part of the force, relative to the largest
MARGIN = 0.01  # m from the edges
SMOOTHNESS = 2e-3  # s, weight of the mean squared jerk, relative to its limit


@dataclasses.dataclass(frozen=True)
class Path:
    """A flight of a point mass, at the nodes of a mesh."""

    leg_times: np.ndarray  # (legs,) s
    position: np.ndarray  # (nodes, 3) m
    velocity: np.ndarray  # (nodes, 3) m/s
    force: np.ndarray  # (nodes, 3) m/s^2, world: the thrust per mass


def spline(problem: Problem, intervals: int, speed: float, seed: int = 0) -> Path:
    """A spline through the gates: its force is the acceleration.

    Args:
        problem: the flight.
        intervals: of a leg.
        speed: m/s, mean of each leg.
        seed: 0: through the centers; others: through random points of the openings.
    """
    gates, order = problem.gates, problem.order
    spread = 0.8 * (seed > 0)
    sides = spread * np.random.default_rng(seed).uniform(-1.0, 1.0, gates.half_size.shape)
    points = gates.position + np.einsum("gs,gsi->gi", sides * gates.half_size, gates.axes[:, 1:])
    points = points[np.concatenate([order[-1:], order])]
    if not problem.periodic:
        points[0] = problem.start[POSITION]
    lengths = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.5)
    times = np.concatenate([[0.0], np.cumsum(lengths / speed)])
    rest = (1, np.zeros(3))
    ends = (rest, rest if problem.flight.stops else (2, np.zeros(3)))
    curve = CubicSpline(times, points, bc_type="periodic" if problem.periodic else ends)
    legs = np.arange(len(order) * intervals + 1) / intervals
    nodes = np.interp(legs, np.arange(len(times)), times)
    return Path(np.diff(times), curve(nodes), curve(nodes, 1), curve(nodes, 2))


def optimize(problem: Problem, first: Path, effort: Effort) -> Path:
    """The time-optimal flight of the point mass, from a first guess as of ``spline``.

    Where the problem limits the pitch, the force points upward. Otherwise it has any direction.
    """
    largest, drag, gravity = _mass(problem)
    legs, nodes = len(first.leg_times), len(first.position)
    program = casadi.Opti()
    t = program.variable(legs)
    p, v, f = (program.variable(3, nodes) for _ in range(3))
    bound(program, t, 0.02, 60.0)
    smooth = _add_equations(program, (largest, drag, gravity), t, p, v, f)
    add_rules(program, problem, p, v, MARGIN, 0.0)
    if problem.periodic:
        ends = casadi.vertcat(*(x[:, -1] - x[:, 0] for x in (p, v, f)))
        bound(program, ends, 0.0, 0.0)
    else:
        bound(program, p[:, 0], first.position[0][:, None], first.position[0][:, None])
        bound(program, v[:, 0], 0.0, 0.0)
    force = first.force + drag * first.velocity - gravity
    if math.isfinite(problem.pitch_limit):
        upright = -UPRIGHT * largest
        bound(program, f[2, :], -np.inf, upright)
        force[:, 2] = np.minimum(force[:, 2], upright)
    size = np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-6)
    force = force * np.minimum(1.0, largest / size)
    for variable, value in ((p, first.position), (v, first.velocity), (f, force)):
        program.set_initial(variable, value.T)
    program.set_initial(t, first.leg_times)
    program.minimize(casadi.sum1(t) + SMOOTHNESS * smooth)
    minimize(program, effort)
    leg_times, *tables = (np.array(program.debug.value(x)) for x in (t, p, v, f))
    return Path(leg_times.ravel(), *(table.T for table in tables))


def _mass(problem: Problem) -> tuple[float, float, np.ndarray]:
    """Largest force, m/s^2, drag, 1/s, of level flight at 3 m/s, and gravity (3,), m/s^2."""
    still, fast, full = problem.level, problem.level.copy(), problem.level.copy()
    fast[VELOCITY], full[ACTUATORS] = [3.0, 0.0, 0.0], problem.actuator_range[1]
    forces = [problem.specific_force(state) for state in (still, fast, full)]
    gravity = np.array([0.0, 0.0, float(problem.params.vehicle.constants.g)])
    return USED_FORCE * float(np.linalg.norm(forces[2])), (forces[0] - forces[1])[0] / 3.0, gravity


def _add_equations(
    program: Any, mass: tuple[float, float, np.ndarray], t: Any, p: Any, v: Any, f: Any
) -> Any:
    """``p'' = gravity + f - drag p'``, and limits of force and jerk.

    Returns:
        The integral of the squared relative jerk, s.
    """
    (largest, drag, gravity), nodes = mass, p.shape[1]
    count = (nodes - 1) // t.numel()
    step = casadi.reshape(casadi.repmat(t.T / count, count, 1), 1, -1)
    h = casadi.repmat(step, 3, 1)
    slope = f - drag * v + casadi.repmat(casadi.DM(gravity), 1, nodes)
    change = 0.5 * h * (v[:, 1:] + v[:, :-1]) - h * h / 12.0 * (slope[:, 1:] - slope[:, :-1])
    bound(program, p[:, 1:] - p[:, :-1] - change, 0.0, 0.0)
    bound(program, v[:, 1:] - v[:, :-1] - 0.5 * h * (slope[:, 1:] + slope[:, :-1]), 0.0, 0.0)
    jerk = (f[:, 1:] - f[:, :-1]) / (TILTING * largest)
    bound(program, jerk - h, -np.inf, 0.0)
    bound(program, -jerk - h, -np.inf, 0.0)
    bound(program, casadi.sum1(f**2) / largest**2, -np.inf, 1.0)
    return casadi.sum2(casadi.sum1(jerk**2) / step)
