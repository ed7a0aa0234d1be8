"""Initial guesses from the time-optimal flight of a point mass with limited force and jerk.

The relaxation has neither attitude nor actuators, so the solver finds its flight quickly from a
spline through the gates. The attitude, the body rates and the commands follow from the flight.
"""

import dataclasses
import threading
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from quadjax.limits.extra import casadi
from quadjax.limits.intervals import gravity
from quadjax.limits.ipopt import Effort, Program, minimize
from quadjax.limits.problem import Problem, leaves
from quadjax.limits.rules import add_rules
from quadjax.limits.simulation import positions

POINT_MASS = "point mass"  # how the names of such guesses begin
USED_FORCE = 0.9  # fraction of the largest thrust; the rest is left for control
TILTING = 10.0  # rad/s, jerk relative to the largest force
UPRIGHT = 0.15  # smallest vertical part of the force, relative to the largest
MARGIN, ITERATIONS = 0.01, 300  # m from the edges; of IPOPT
SMOOTHNESS = 2e-3  # s, weight of the mean squared jerk, relative to its limit


@dataclasses.dataclass(frozen=True)
class Path:
    """A flight of a point mass, at the nodes of a mesh."""

    leg_times: np.ndarray  # (legs,) s
    position: np.ndarray  # (nodes, 3) m
    velocity: np.ndarray  # (nodes, 3) m/s
    force: np.ndarray  # (nodes, 3) m/s^2, world: the thrust per mass


@dataclasses.dataclass(frozen=True)
class Mass:
    """The point mass: ``p'' = gravity + f - drag p'``."""

    force: float  # m/s^2, largest
    drag: float  # 1/s
    gravity: np.ndarray  # (3,)


def mass_of(problem: Problem) -> Mass:
    """Largest thrust at rest, and drag of level flight at 3 m/s."""
    model, speed = problem.model, 3.0
    high = leaves(model.actuator_range(problem.vehicle.constants)[1])
    fast, still = (
        problem.hover_at(np.zeros(3), np.array([v, 0.0, 0.0]), np.zeros(3)) for v in (speed, 0.0)
    )
    full = still.copy()
    full[problem.actuator_leaves] = high

    force = problem.specific_force
    drag = (force(still)[0] - force(fast)[0]) / speed
    return Mass(USED_FORCE * float(np.linalg.norm(force(full))), drag, gravity(problem))


def spline(
    problem: Problem, intervals: int, speed: float, spread: float, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Leg durations (legs,), and position, velocity, acceleration (nodes, 3) on a spline.

    Args:
        problem: the flight.
        intervals: of a leg.
        speed: m/s, mean of each leg.
        spread: fraction of the opening within which random points replace the centers.
        rng: of these points.
    """
    gates, order = problem.gates, problem.order
    sides = spread * rng.uniform(-1.0, 1.0, (problem.gate_count, 2)) * gates.half_size
    points = gates.position + np.einsum("gs,gsi->gi", sides, gates.axes[:, 1:])
    periodic = problem.start == "periodic"
    points = points[np.concatenate([[problem.gate_count - 1], order])]
    if not periodic:
        points[0] = positions(problem, leaves(problem.hover_state)[None])[0]
    lengths = np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 0.5)
    times = np.concatenate([[0.0], np.cumsum(lengths / speed)])
    rest = (1, np.zeros(3))
    ends = "periodic" if periodic else (rest, rest if problem.stops else (2, np.zeros(3)))
    if periodic:
        points[-1] = points[0]
    curve = CubicSpline(times, points, bc_type=ends)
    nodes = np.interp(
        np.arange(len(order) * intervals + 1) / intervals, np.arange(len(times)), times
    )
    return np.diff(times), curve(nodes), curve(nodes, 1), curve(nodes, 2)


def optimize(
    problem: Problem,
    first: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    seconds: float,
    stop: threading.Event,
) -> Path:
    """The time-optimal flight of the point mass, from a first guess as of ``spline``.

    Where the problem limits the pitch, the force points upward. Otherwise it has any direction.
    """
    mass = mass_of(problem)
    durations, *parts = first
    legs, nodes = len(durations), len(parts[0])
    t = casadi.MX.sym("t", legs)
    p, v, f = (casadi.MX.sym(name, 3, nodes) for name in "pvf")
    program = Program()
    smooth = _add_equations(program, mass, t, p, v, f)
    add_rules(program, problem, p, v, (nodes - 1) // legs, MARGIN)
    if problem.start == "periodic":
        program.add(casadi.vertcat(*(x[:, -1] - x[:, 0] for x in (p, v, f))), 0.0, 0.0)
    upright = -UPRIGHT * mass.force if np.isfinite(problem.pitch_limit) else np.inf
    force = parts[2] + mass.drag * parts[1] - mass.gravity
    force[:, 2] = np.minimum(force[:, 2], upright)
    size = np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-6)
    force *= np.minimum(1.0, mass.force / size)
    guess = np.concatenate([durations, parts[0].ravel(), parts[1].ravel(), force.ravel()])
    low, high = np.full(len(guess), -np.inf), np.full(len(guess), np.inf)
    low[:legs], high[:legs] = 0.02, 60.0
    high[legs + 6 * nodes + 2 :: 3] = upright
    if problem.start == "hover":
        for offset, value in ((legs, parts[0][0]), (legs + 3 * nodes, 0.0)):
            low[offset : offset + 3] = high[offset : offset + 3] = value
    variables = casadi.vertcat(t, *(casadi.vec(x) for x in (p, v, f)))
    objective, effort = casadi.sum1(t) + SMOOTHNESS * smooth, Effort(seconds, ITERATIONS, stop=stop)
    values, _, _ = minimize(program, variables, objective, (low, high), guess, effort)
    tables = np.split(values[legs:], 3)
    return Path(values[:legs], *(table.reshape(nodes, 3) for table in tables))


def _add_equations(program: Program, mass: Mass, t: Any, p: Any, v: Any, f: Any) -> Any:
    """Motion, limits of force and jerk; returns the integral of the squared relative jerk, s."""
    nodes = p.shape[1]
    count = (nodes - 1) // t.numel()
    step = casadi.reshape(casadi.repmat(t.T / count, count, 1), 1, -1)
    h = casadi.repmat(step, 3, 1)
    slope = f - mass.drag * v + casadi.repmat(casadi.DM(mass.gravity), 1, nodes)
    program.add(
        p[:, 1:]
        - p[:, :-1]
        - 0.5 * h * (v[:, 1:] + v[:, :-1])
        + h * h / 12.0 * (slope[:, 1:] - slope[:, :-1]),
        0.0,
        0.0,
    )
    program.add(v[:, 1:] - v[:, :-1] - 0.5 * h * (slope[:, 1:] + slope[:, :-1]), 0.0, 0.0)
    most = TILTING * mass.force
    jerk = f[:, 1:] - f[:, :-1]
    program.add(jerk / most - h, -np.inf, 0.0)
    program.add(-jerk / most - h, -np.inf, 0.0)
    program.add(casadi.sum1(f**2) / mass.force**2, 0.0, 1.0)
    return casadi.sum2(casadi.sum1((jerk / most) ** 2) / step)
