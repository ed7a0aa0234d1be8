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
from quadjax.limits.rules import add_rules, bound
from quadjax.limits.trajectory import Trajectory
from quadjax.limits.translate import casadi, translate

SMOOTHNESS = 1e-4  # s, weight of the squared command differences, relative to the command range
LOWEST = 1e-3  # of a command's range, left out: a motor map may have no slope at its lowest command
LEG_SECONDS = (0.02, 60.0)
ITERATIONS = 500  # of IPOPT, at most
UNLIMITED = 500.0  # rad/s, body rates that no drone reaches


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is solved, in addition to the flight's own rules, and when IPOPT ends."""

    margin: float = 0.0  # m, further distance from the edges of the openings and the bounds
    reserve: float = 0.0  # fraction of the ranges of commands that is not used
    turning: float = 1.0  # fraction of the body rates' limits
    smoothness: float = SMOOTHNESS  # s, weight of the squared command differences
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
        self.still = np.array([casadi.SX(x).is_zero() for x in casadi.vertsplit(slope0)], bool)
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

    Args:
        problem: the flight.
        dynamics: of the problem.
        guess: the initial guess, with the same number of intervals for each leg.
        settings: margins, weights and limits.
        stop: if set, the solver ends with its current iterate.
        report: called at each iteration with the objective, s.
    """
    program, (low, high), count = casadi.Opti(), problem.command_range, guess.intervals
    span, reserve = np.where(high > low, high - low, 1.0), settings.reserve
    ends = low + max(LOWEST, reserve) * span, high - reserve * span
    scales = (
        np.maximum(np.abs(guess.states).max(axis=0), 1.0),
        np.maximum(np.abs(low), np.abs(high)),
    )
    durations = program.variable(len(guess.leg_times))
    scaled = [program.variable(len(scale), len(guess.states)) for scale in scales]
    x, u = (variable * scale for variable, scale in zip(scaled, scales, strict=True))
    program.set_initial(durations, guess.leg_times)
    for variable, table, scale in zip(scaled, (guess.states, guess.commands), scales, strict=True):
        program.set_initial(variable, (table / scale).T)
    bound(program, durations, *LEG_SECONDS)
    bound(program, u, *(end[:, None] for end in ends))
    step = casadi.reshape(casadi.repmat(durations.T / count, count, 1), 1, -1)
    interval = dynamics.interval.map(len(guess.states) - 1)
    defect, between = interval(x[:, :-1], u[:, :-1], x[:, 1:], u[:, 1:], step)
    moving = np.flatnonzero(~dynamics.still)
    bound(program, defect[moving.tolist(), :] / scales[0][moving], 0.0, 0.0)
    _add_ends(program, problem, dynamics.still, guess, x, u)
    add_rules(program, problem, x[POSITION, :], x[VELOCITY, :], settings.margin)
    limit = settings.turning * problem.rate_limit
    for axis in np.flatnonzero(limit < UNLIMITED):
        rates = casadi.horzcat(x[RATES, 1:], between)[int(axis), :]
        bound(program, rates, -limit[axis], limit[axis])
    if math.isfinite(problem.pitch_limit):
        q0, q1, q2, q3 = casadi.vertsplit(x[ATTITUDE, 1:])
        steepest = math.sin(problem.pitch_limit)
        bound(program, 2.0 * (q0 * q2 - q1 * q3), -steepest, steepest)
    smooth = casadi.sumsqr((u[:, 1:] - u[:, :-1]) / span)
    program.minimize(casadi.sum1(durations) + settings.smoothness * smooth)
    converged, status = _minimize(program, settings, stop, report)
    leg_times, states, commands = (np.array(program.debug.value(v)).T for v in (durations, x, u))
    return Solution(
        Trajectory(leg_times.ravel(), states, np.clip(commands, *ends)), converged, status
    )


def _add_ends(
    program: Any, problem: Problem, still: np.ndarray, guess: Trajectory, x: Any, u: Any
) -> None:
    """The start, or the end of a periodic flight: it equals the start up to a quaternion's sign.

    Of the quaternion there, the largest component is left out: the norm determines it.
    """
    start = problem.start[:, None]
    if still.any():
        bound(program, x[np.flatnonzero(still).tolist(), :], start[still], start[still])
    if not problem.periodic:
        bound(program, x[:, 0], start, start)
        return
    first, last = guess.states[0, ATTITUDE], guess.states[-1, ATTITUDE]
    sign = np.ones(len(start))
    sign[ATTITUDE] = 1.0 if first @ last >= 0.0 else -1.0
    closed = ~still
    closed[ATTITUDE.start + int(np.argmax(np.abs(first)))] = False
    bound(program, (x[:, -1] - sign * x[:, 0])[np.flatnonzero(closed).tolist()], 0.0, 0.0)
    bound(program, u[:, -1] - u[:, 0], 0.0, 0.0)
    bound(program, casadi.sumsqr(x[ATTITUDE, 0]), 1.0, 1.0)


def _minimize(
    program: Any, settings: Settings, stop: threading.Event, report: Callable[[float], object]
) -> tuple[bool, str]:
    """Whether IPOPT converged, and its status; then ``debug.value`` gives the last iterate."""
    options = {
        "print_level": 0,
        "sb": "yes",
        "tol": 1e-6,
        "acceptable_tol": 1e-5,
        "max_iter": ITERATIONS,
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
