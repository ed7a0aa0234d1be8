"""Direct collocation of a time-optimal flight: Hermite-Simpson, solved by IPOPT.

Each leg, from one gate to the next, has its own duration and a number of equal intervals. States
and commands at the nodes are the variables; commands are linear within an interval. The equations
of motion hold at the ends and the middle of each interval.
"""

import contextlib
import dataclasses
import io
import math
import threading
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from quadjax.limits.problem import ATTITUDE, POSITION, RATES, VELOCITY, Problem
from quadjax.limits.trajectory import Trajectory
from quadjax.limits.translate import casadi, translate
from quadjax.race.rules import TAKEOFF_DEPTH_M

SMOOTHNESS_S = 1e-4  # weight of the squared command differences, relative to the command range
LEFT_OUT_FRACTION = 1e-3  # of a command's range: a motor map may have no slope at its lowest
LEG_SECONDS = (0.02, 60.0)
MAX_ITERATIONS = 500  # of IPOPT
SLOWEST_PASSAGE_M_S = 0.2  # smallest speed through a gate
BEYOND_PLANE_M = 1e-5  # at the end of a leg; much less than any margin
UNLIMITED_RAD_S = 500.0  # body rates that no drone reaches


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is solved, in addition to the flight's own rules, and when IPOPT ends."""

    margin: float = 0.0  # m, further distance from the edges of the openings and the bounds
    reserve: float = 0.0  # fraction of the ranges of commands that is not used
    rate_share: float = 1.0  # fraction of the body rates' limits
    smoothness: float = SMOOTHNESS_S  # s, weight of the squared command differences
    seconds: float = 300.0  # limit of wall-clock time
    warm: bool = False  # the guess is close to a solution, as from a coarser mesh


class Solution(NamedTuple):
    """The result of one solve: the last iterate where it did not converge."""

    trajectory: Trajectory
    converged: bool
    status: str  # IPOPT's


class Dynamics:
    """The vehicle's equations as CasADi functions of its state and command."""

    def __init__(self, problem: Problem) -> None:
        """Translate the model's equations."""
        start, (low, _) = problem.start, problem.command_range
        slope = translate(problem.slope, start, low)
        x0, x1 = (casadi.SX.sym(name, len(start)) for name in ("x0", "x1"))
        u0, u1 = (casadi.SX.sym(name, len(low)) for name in ("u0", "u1"))
        step, slope0, slope1 = casadi.SX.sym("step"), slope(x0, u0), slope(x1, u1)
        middle = 0.5 * (x0 + x1) + step / 8.0 * (slope0 - slope1)
        change = step / 6.0 * (slope0 + 4.0 * slope(middle, 0.5 * (u0 + u1)) + slope1)
        # Actuators without a lag: the commands replace them.
        slopes = casadi.vertsplit(slope0)
        self.without_lag = np.array([casadi.SX(x).is_zero() for x in slopes], bool)
        # The defect of Hermite-Simpson collocation, and the body rates in the middle, rad/s.
        results = [x1 - x0 - change, middle[RATES]]
        self.slope = casadi.Function("slope", [x0, u0], [slope0])
        self.interval = casadi.Function("interval", [x0, u0, x1, u1, step], results)


def solve(
    problem: Problem,
    dynamics: Dynamics,
    guess: Trajectory,
    settings: Settings,
    stop: threading.Event,
    report: Callable[[float], object],
) -> Solution:
    """Solve the nonlinear program on the mesh of an initial guess.

    ``report`` gets the objective, s, of each iteration. If ``stop`` is set, the solver ends with
    its current iterate.
    """
    program, (low, high), count = casadi.Opti(), problem.command_range, guess.intervals
    span, reserve = np.where(high > low, high - low, 1.0), settings.reserve
    ends = low + max(LEFT_OUT_FRACTION, reserve) * span, high - reserve * span
    scales = (
        np.maximum(np.abs(guess.states).max(axis=0), 1.0),
        np.maximum(np.abs(low), np.abs(high)),
    )
    durations = program.variable(len(guess.leg_times))
    nodes = [program.variable(len(scale), len(guess.states)) for scale in scales]
    x, u = (variable * scale for variable, scale in zip(nodes, scales, strict=True))
    program.set_initial(durations, guess.leg_times)
    for variable, table, scale in zip(nodes, (guess.states, guess.commands), scales, strict=True):
        program.set_initial(variable, (table / scale).T)
    add_bound(program, durations, *LEG_SECONDS)
    add_bound(program, u, *(end[:, None] for end in ends))
    step = casadi.reshape(casadi.repmat(durations.T / count, count, 1), 1, -1)
    interval = dynamics.interval.map(len(guess.states) - 1)
    defect, between = interval(x[:, :-1], u[:, :-1], x[:, 1:], u[:, 1:], step)
    lagging = np.flatnonzero(~dynamics.without_lag)
    add_bound(program, defect[lagging.tolist(), :] / scales[0][lagging], 0.0, 0.0)
    _add_ends(program, problem, dynamics.without_lag, guess, x, u)
    add_rules(program, problem, x[POSITION, :], x[VELOCITY, :], settings.margin)
    limit = settings.rate_share * problem.rate_limit
    for axis in np.flatnonzero(limit < UNLIMITED_RAD_S):
        rates = casadi.horzcat(x[RATES, 1:], between)[int(axis), :]
        add_bound(program, rates, -limit[axis], limit[axis])
    if math.isfinite(problem.pitch_limit):
        q0, q1, q2, q3 = casadi.vertsplit(x[ATTITUDE, 1:])
        steepest = math.sin(problem.pitch_limit)
        add_bound(program, 2.0 * (q0 * q2 - q1 * q3), -steepest, steepest)
    smooth = casadi.sumsqr((u[:, 1:] - u[:, :-1]) / span)
    program.minimize(casadi.sum1(durations) + settings.smoothness * smooth)
    converged, status = _minimize(program, settings, stop, report)
    leg_times, states, commands = (np.array(program.debug.value(v)).T for v in (durations, x, u))
    return Solution(
        Trajectory(leg_times.ravel(), states, np.clip(commands, *ends)), converged, status
    )


def _add_ends(
    program: Any, problem: Problem, without_lag: np.ndarray, guess: Trajectory, x: Any, u: Any
) -> None:
    """The start, or the end of a periodic flight: it equals the start up to a quaternion's sign.

    Of the quaternion there, the largest component is left out: the norm determines it.
    """
    start = problem.start[:, None]
    if without_lag.any():
        given = start[without_lag]
        add_bound(program, x[np.flatnonzero(without_lag).tolist(), :], given, given)
    if not problem.periodic:
        add_bound(program, x[:, 0], start, start)
        return
    first, last = guess.states[0, ATTITUDE], guess.states[-1, ATTITUDE]
    sign = np.ones(len(start))
    sign[ATTITUDE] = 1.0 if first @ last >= 0.0 else -1.0
    closed = ~without_lag
    closed[ATTITUDE.start + int(np.argmax(np.abs(first)))] = False
    add_bound(program, (x[:, -1] - sign * x[:, 0])[np.flatnonzero(closed).tolist()], 0.0, 0.0)
    add_bound(program, u[:, -1] - u[:, 0], 0.0, 0.0)
    add_bound(program, casadi.sumsqr(x[ATTITUDE, 0]), 1.0, 1.0)


def _minimize(
    program: Any, settings: Settings, stop: threading.Event, report: Callable[[float], object]
) -> tuple[bool, str]:
    """Whether IPOPT converged, and its status; then ``debug.value`` gives the last iterate."""
    options = {
        "print_level": 0,
        "sb": "yes",
        "tol": 1e-6,
        "acceptable_tol": 1e-5,
        "max_iter": MAX_ITERATIONS,
        "max_wall_time": max(0.1, settings.seconds),
        "mu_init": 1e-4 if settings.warm else 1e-2,
        "bound_relax_factor": 0.0,  # a motor map has no slope beyond its lowest command
    }
    if settings.warm:
        options |= {"bound_push": 1e-5, "bound_frac": 1e-5}
    quiet = {"print_time": False, "show_eval_warnings": False, "detect_simple_bounds": True}
    program.solver("ipopt", quiet, options)
    with contextlib.ExitStack() as silence:

        def iteration(_: int) -> None:
            report(float(program.debug.value(program.f)))
            if stop.is_set():  # an exception ends IPOPT; CasADi would print it
                silence.enter_context(contextlib.redirect_stderr(io.StringIO()))
                raise KeyboardInterrupt

        program.callback(iteration)
        with contextlib.suppress(RuntimeError):  # the status says why
            program.solve()
    stats = program.stats()
    return bool(stats["success"]), str(stats["return_status"])


def add_bound(program: Any, expression: Any, low: Any, high: Any) -> None:
    """Add ``low <= expression <= high``, which broadcast to the shape of the expression."""
    ends = (np.broadcast_to(np.asarray(end, float), expression.shape) for end in (low, high))
    low, high = (casadi.DM(end.ravel("F")) for end in ends)
    program.subject_to(program.bounded(low, casadi.vec(expression), high))


def add_rules(program: Any, problem: Problem, position: Any, velocity: Any, margin: float) -> None:
    """Gates at the ends of the legs; bounds, ground and speed at all nodes (3, nodes), m and m/s.

    The ``margin``, m, is a further distance from the edges of the openings, the bounds and the
    ground.
    """
    stops, nodes, legs = problem.flight.stops, position.shape[1], len(problem.order)
    count, (low, high) = (nodes - 1) // legs, problem.bounds[..., None]
    add_bound(program, position[:, 1 : nodes - stops], low + margin, high - margin)
    add_bound(program, casadi.sum1(velocity[:, 1:] ** 2), -np.inf, problem.speed_limit**2)
    if problem.landing is not None:
        _add_ground(program, problem, position, velocity, margin)
    for leg, gate in enumerate(problem.order, 1):
        place, speed = position[:, leg * count], velocity[:, leg * count]
        if stops and leg == legs:
            add_bound(program, place, *[problem.gates.position[gate][:, None]] * 2)
            add_bound(program, speed, 0.0, 0.0)
        else:
            _add_gate(program, problem, gate, place, speed, margin)


def _add_ground(
    program: Any, problem: Problem, position: Any, velocity: Any, margin: float
) -> None:
    """Slow flight near the ground: on the first leg after a start there, elsewhere none."""
    assert problem.landing is not None
    (height, speed), count = problem.landing, (position.shape[1] - 1) // len(problem.order)
    first = 1 if problem.periodic else 1 + count
    add_bound(program, position[2, first:], -np.inf, -height - margin)
    if not problem.periodic:
        slope = speed**2 / (height + TAKEOFF_DEPTH_M)  # at TAKEOFF_DEPTH_M no speed is left
        allowed = speed**2 - slope * (position[2, 1:first] + height)
        add_bound(program, casadi.sum1(velocity[:, 1:first] ** 2) - allowed, -np.inf, 0.0)


def _add_gate(
    program: Any, problem: Problem, gate: int, place: Any, velocity: Any, margin: float
) -> None:
    """The passage of one gate at one node."""
    gates, clearance = problem.gates, problem.flight.clearance
    offset = place - gates.position[gate]
    local, speed = (casadi.mtimes(gates.axes[gate], vector) for vector in (offset, velocity))
    add_bound(program, local[0], BEYOND_PLANE_M, BEYOND_PLANE_M)
    add_bound(program, speed[0], SLOWEST_PASSAGE_M_S, np.inf)
    if clearance is None:
        add_bound(program, local[1:], 0.0, 0.0)
        return
    places = [local]
    if problem.frame_depth is not None:  # through it, along the velocity
        way = problem.frame_depth / speed[0] * speed
        places = [local - way, local + way]
    half = np.maximum(gates.half_size[gate] - clearance - margin, 0.0)[:, None]
    for inside in places:
        if gates.circle[gate] and half[0] > 0.0:
            add_bound(program, casadi.sumsqr(inside[1:]) / half[0] ** 2, -np.inf, 1.0)
        else:
            add_bound(program, inside[1:], -half, half)
