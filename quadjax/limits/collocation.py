"""Direct collocation of a time-optimal flight: Hermite-Simpson, solved by IPOPT.

Each leg, from one gate to the next, has its own duration and a number of equal intervals. States
and commands at the nodes are the variables; commands are linear within an interval. The equations
of motion hold at the ends and the middle of each interval.
"""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np

from quadjax.limits.problem import ATTITUDE, POSITION, RATES, VELOCITY, Problem
from quadjax.limits.program import Effort, add_rules, bound, minimize
from quadjax.limits.trajectory import Trajectory
from quadjax.limits.translate import casadi, translate

SMOOTHNESS = 1e-4  # s, weight of the squared command differences, relative to the command range
LOWEST = 1e-3  # of a command's range, left out: a motor map may have no slope at its lowest command
LEG_SECONDS = (0.02, 60.0)
UNLIMITED = 500.0  # rad/s, body rates that no drone reaches


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is solved, in addition to the flight's own rules.

    Attributes:
        margin: m, further distance from the edges of the openings, the bounds and the ground.
        reserve: fraction of the ranges of commands, body rates and speed that is not used.
        smoothness: s, weight of the squared command differences, relative to the command range.
    """

    margin: float = 0.0
    reserve: float = 0.0
    smoothness: float = SMOOTHNESS


class Solution(NamedTuple):
    """The result of one solve: the last iterate where it did not converge."""

    trajectory: Trajectory
    converged: bool
    status: str  # IPOPT's


class Dynamics:
    """The vehicle's equations as CasADi functions of its state and command."""

    def __init__(self, problem: Problem) -> None:
        """Translate the model's equations."""
        x = casadi.SX.sym("x", len(problem.start))
        u = casadi.SX.sym("u", len(problem.command_range[0]))
        slope = translate(problem.slope, problem.start, problem.command_range[0])(x, u)
        self.slope = casadi.Function("slope", [x, u], [slope])
        still = [bool(casadi.SX(each).is_zero()) for each in casadi.vertsplit(slope)]
        self.still = np.array(still)  # actuators without a lag: the commands replace them

    def interval(self, scale: np.ndarray, command_scale: np.ndarray) -> Any:
        """The defect of Hermite-Simpson collocation, and the body rates in the middle, rad/s.

        Of scaled states and commands.
        """
        x0, x1 = casadi.SX.sym("x0", len(scale)), casadi.SX.sym("x1", len(scale))
        u0, u1 = (casadi.SX.sym(name, len(command_scale)) for name in ("u0", "u1"))
        step = casadi.SX.sym("step")
        slope0, slope1 = (
            self.slope(x * scale, u * command_scale) / scale for x, u in ((x0, u0), (x1, u1))
        )
        middle = 0.5 * (x0 + x1) + step / 8.0 * (slope0 - slope1)
        slope = self.slope(middle * scale, 0.5 * (u0 + u1) * command_scale) / scale
        defect = x1 - x0 - step / 6.0 * (slope0 + 4.0 * slope + slope1)
        results = [defect[np.flatnonzero(~self.still).tolist()], (middle * scale)[RATES]]
        return casadi.Function("interval", [x0, u0, x1, u1, step], results)


def solve(
    problem: Problem, dynamics: Dynamics, guess: Trajectory, settings: Settings, effort: Effort
) -> Solution:
    """Solve the nonlinear program on the mesh of an initial guess.

    Args:
        problem: the flight.
        dynamics: of the problem.
        guess: the initial guess, with the same number of intervals for each leg.
        settings: margins and weights.
        effort: when the solver ends.
    """
    program, (low, high), count = casadi.Opti(), problem.command_range, guess.intervals
    scale = np.maximum(np.abs(guess.states).max(axis=0), 1.0)
    command_scale = np.maximum(np.abs(low), np.abs(high))
    span = np.where(high > low, high - low, 1.0)
    low, high = low + max(LOWEST, settings.reserve) * span, high - settings.reserve * span
    durations = program.variable(len(guess.leg_times))
    x = program.variable(len(scale), len(guess.states))
    u = program.variable(len(low), len(guess.states))
    program.set_initial(durations, guess.leg_times)
    program.set_initial(x, (guess.states / scale).T)
    program.set_initial(u, (guess.commands / command_scale).T)
    bound(program, durations, *LEG_SECONDS)
    bound(program, u, (low / command_scale)[:, None], (high / command_scale)[:, None])
    step = casadi.reshape(casadi.repmat(durations.T / count, count, 1), 1, -1)
    interval = dynamics.interval(scale, command_scale).map(len(guess.states) - 1)
    defect, between = interval(x[:, :-1], u[:, :-1], x[:, 1:], u[:, 1:], step)
    bound(program, defect, 0.0, 0.0)
    _add_ends(program, problem, dynamics.still, guess, x, u, scale)
    states = x * scale
    place, speed = states[POSITION, :], states[VELOCITY, :]
    add_rules(program, problem, place, speed, settings.margin, settings.reserve)
    rates = casadi.horzcat(states[RATES, 1:], between)
    _add_limits(program, problem, states, rates, settings.reserve)
    smooth = casadi.sumsqr((u[:, 1:] - u[:, :-1]) * (command_scale / span))
    program.minimize(casadi.sum1(durations) + settings.smoothness * smooth)
    converged, status = minimize(program, effort)
    leg_times, states, commands = (np.array(program.debug.value(v)) for v in (durations, x, u))
    states, commands = states.T * scale, np.clip(commands.T * command_scale, low, high)
    return Solution(Trajectory(leg_times.ravel(), states, commands), converged, status)


def _add_limits(program: Any, problem: Problem, states: Any, rates: Any, reserve: float) -> None:
    """Body rates, also between the nodes, and the pitch."""
    limit, pitch = (1.0 - reserve) * problem.rate_limit, problem.pitch_limit
    for axis in np.flatnonzero(limit < UNLIMITED):
        bound(program, rates[int(axis), :], -limit[axis], limit[axis])
    if math.isfinite(pitch):
        w, x, y, z = casadi.vertsplit(states[ATTITUDE, 1:])
        bound(program, 2.0 * (w * y - x * z), -math.sin(pitch), math.sin(pitch))


def _add_ends(
    program: Any,
    problem: Problem,
    still: np.ndarray,
    guess: Trajectory,
    x: Any,
    u: Any,
    scale: np.ndarray,
) -> None:
    """The start, or the end of a periodic flight: it equals the start up to a quaternion's sign.

    Of the quaternion there, the largest component is left out: the norm determines it.
    """
    start = (problem.start / scale)[:, None]
    if still.any():
        bound(program, x[np.flatnonzero(still).tolist(), :], start[still], start[still])
    if not problem.periodic:
        bound(program, x[:, 0], start, start)
        return
    first, last = guess.states[0, ATTITUDE], guess.states[-1, ATTITUDE]
    sign = np.ones(len(scale))
    sign[ATTITUDE] = 1.0 if first @ last >= 0.0 else -1.0
    closed = ~still
    closed[ATTITUDE.start + int(np.argmax(np.abs(first)))] = False
    bound(program, (x[:, -1] - sign * x[:, 0])[np.flatnonzero(closed).tolist()], 0.0, 0.0)
    bound(program, u[:, -1] - u[:, 0], 0.0, 0.0)
    bound(program, casadi.sumsqr(x[ATTITUDE, 0] * scale[ATTITUDE]), 1.0, 1.0)
