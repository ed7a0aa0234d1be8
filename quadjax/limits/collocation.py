"""Direct collocation of a time-optimal flight: Hermite-Simpson, solved by IPOPT.

Each leg, from one gate to the next, has its own duration and a number of equal intervals. States
and commands at the nodes are the variables; commands are linear within an interval. The equations
of motion hold at the ends and the middle of each interval.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from quadjax.core.vectors import Vec3
from quadjax.limits.extra import OPERATIONS, casadi
from quadjax.limits.ipopt import Effort, Program, minimize
from quadjax.limits.jaxpr import translate
from quadjax.limits.problem import Problem, leaves
from quadjax.limits.rules import Wall, add_rules
from quadjax.limits.trajectory import Trajectory

SMOOTHNESS = 1e-4  # s, weight of the squared command differences, relative to the command range
SMALL_RATE = 100.0  # rad/s
STEEP, MOST_SLOPE = 1e-3, 100.0  # reserve of steep commands, and from what relative slope on
LEG_SECONDS = (0.02, 60.0)


@dataclasses.dataclass(frozen=True)
class Solution:
    """The result of one solve."""

    trajectory: Trajectory
    converged: bool
    status: str  # IPOPT's
    seconds: float  # of processor time


class Dynamics:
    """The vehicle's equations as CasADi functions of its state leaves and commands."""

    def __init__(self, problem: Problem) -> None:
        """Translate the model's ``derivative`` and the quantities of a state that the rules use."""
        model, low = problem.model, problem.command_range[0]
        self.state_count, self.command_count = len(leaves(problem.hover_state)), len(low)
        x = [casadi.SX.sym(f"x{index}") for index in range(self.state_count)]
        u = [casadi.SX.sym(f"u{index}") for index in range(self.command_count)]
        slope = translate(
            lambda state, command: model.derivative(
                problem.vehicle, model.hold(_unit(problem, state), command), command
            ),
            OPERATIONS,
            problem.hover_state,
            problem.command(low),
        )(*x, *u)
        seen = translate(_seen(model), OPERATIONS, problem.hover_state)(*x)
        state, command = casadi.vertcat(*x), casadi.vertcat(*u)
        self.slope = casadi.Function("slope", [state, command], [casadi.vertcat(*slope)])
        self.seen = casadi.Function("seen", [state], [casadi.vertcat(*seen)])
        self.constant = np.array([casadi.SX(each).is_zero() for each in slope])
        self.lowest = np.where(_steep(problem, self.slope), STEEP, 0.0)

    def interval(self, scale: np.ndarray, command_scale: np.ndarray) -> Any:
        """The defect of Hermite-Simpson collocation, and the body rates in the middle, rad/s.

        Of scaled states and commands.
        """
        count = self.state_count
        x0, x1 = casadi.SX.sym("x0", count), casadi.SX.sym("x1", count)
        u0, u1 = (casadi.SX.sym(name, self.command_count) for name in ("u0", "u1"))
        step = casadi.SX.sym("step")
        slope0, slope1 = (
            self.slope(x * scale, u * command_scale) / scale for x, u in ((x0, u0), (x1, u1))
        )
        middle = 0.5 * (x0 + x1) + step / 8.0 * (slope0 - slope1)
        slope = self.slope(middle * scale, 0.5 * (u0 + u1) * command_scale) / scale
        defect = x1 - x0 - step / 6.0 * (slope0 + 4.0 * slope + slope1)
        moving = [index for index in range(count) if not self.constant[index]]
        rates = self.seen(middle * scale)[6:9]
        return casadi.Function("interval", [x0, u0, x1, u1, step], [defect[moving], rates])


def _steep(problem: Problem, slope: Any) -> np.ndarray:
    """Which commands (commands,) have an unbounded derivative at the lowest, as motor maps."""
    (low, high), state = problem.command_range, leaves(problem.hover_state)
    value = lambda command: np.array(slope(state, command)).ravel()  # noqa: E731
    found = []
    for index in range(len(low)):
        step = np.where(np.arange(len(low)) == index, high - low, 0.0)
        near, whole = (np.abs(value(low + x * step) - value(low)) / x for x in (1e-8, 1.0))
        found.append(bool(np.any(near > MOST_SLOPE * (whole + 1e-9 * near.max()))))
    return np.array(found)


def _unit(problem: Problem, state: Any) -> Any:
    """The state with its quaternion normalized: its length on a coarse mesh changes no force."""
    if not problem.normalized.any():
        return state
    kept, wrapped = (jax.tree.leaves(x) for x in (state, problem.model.wrap(state)))
    pairs = zip(kept, wrapped, problem.normalized, strict=True)
    return problem.state([unit if chosen else own for own, unit, chosen in pairs])


def _seen(model: Any) -> Callable[[Any], tuple]:
    def seen(state: Any) -> tuple:
        position, velocity, rates = model.position(state), model.velocity(state), model.rates(state)
        return (*_xyz(position), *_xyz(velocity), *_xyz(rates), model.euler(state).y)

    return seen


def _xyz(vector: Vec3) -> tuple:
    return vector.components()


@dataclasses.dataclass(frozen=True)
class Settings:
    """What is solved, in addition to the flight's own rules.

    Attributes:
        margin: m, further distance from the edges of the openings, the bounds and the ground.
        reserve: fraction of the commands' ranges that is not used at either end.
        smoothness: s, weight of the squared command differences, relative to the command range.
        rate_limit: rad/s, (3,), in place of the problem's.
        walls: sides of solid frames.
    """

    margin: float = 0.0
    reserve: float = 0.0
    smoothness: float = SMOOTHNESS
    rate_limit: np.ndarray | None = None
    walls: tuple[Wall, ...] = ()


class Unknowns:
    """The variables of the program: durations, and scaled states and commands at the nodes."""

    def __init__(self, problem: Problem, guess: Trajectory) -> None:
        """Symbols for the mesh of a guess, and their scales."""
        low, high = problem.command_range
        self.legs, self.nodes = len(guess.leg_times), len(guess.states)
        self.scale = np.maximum(np.abs(guess.states).max(axis=0), 1.0)
        self.command_scale = np.maximum(np.abs(low), np.abs(high))
        self.states = casadi.MX.sym("x", len(self.scale), self.nodes)
        self.commands = casadi.MX.sym("u", len(low), self.nodes)
        self.durations = casadi.MX.sym("t", self.legs)

    @property
    def symbols(self) -> Any:
        """All variables as a column."""
        parts = self.durations, casadi.vec(self.states), casadi.vec(self.commands)
        return casadi.vertcat(*parts)

    def pack(self, leg_times: Any, states: np.ndarray, commands: np.ndarray) -> np.ndarray:
        """Values of the variables (n,); arguments may broadcast to the shapes of a trajectory."""
        return np.concatenate(
            [
                np.broadcast_to(leg_times, self.legs),
                np.broadcast_to(states / self.scale, self.states.shape[::-1]).ravel(),
                np.broadcast_to(commands / self.command_scale, self.commands.shape[::-1]).ravel(),
            ]
        )

    def unpack(self, values: np.ndarray) -> Trajectory:
        """The inverse of ``pack``."""
        states, commands = np.split(values[self.legs :], [self.states.numel()])
        return Trajectory(
            values[: self.legs],
            states.reshape(self.nodes, -1) * self.scale,
            commands.reshape(self.nodes, -1) * self.command_scale,
        )


def solve(
    problem: Problem,
    dynamics: Dynamics,
    guess: Trajectory,
    settings: Settings | None = None,
    effort: Effort | None = None,
) -> Solution:
    """Solve the nonlinear program on the mesh of an initial guess.

    Args:
        problem: the flight.
        dynamics: of the problem.
        guess: the initial guess, with the same number of intervals for each leg.
        settings: margins, weights and further limits.
        effort: when the solver ends.
    """
    began, settings = time.process_time(), settings or Settings()
    unknowns, program = Unknowns(problem, guess), Program()
    x, u = unknowns.states, unknowns.commands
    _add_equations(program, problem, dynamics, unknowns, guess, settings)
    if problem.start == "periodic":
        _add_period(program, problem, dynamics, x, u, guess, unknowns.scale)
    low, high = problem.command_range
    span = np.where(high > low, high - low, 1.0)
    smooth = casadi.sumsqr((u[:, 1:] - u[:, :-1]) * (unknowns.command_scale / span))
    lowest = np.maximum(dynamics.lowest, settings.reserve)
    low, high = low + lowest * (high - low), high - settings.reserve * (high - low)
    states = _state_bounds(problem, dynamics, unknowns.nodes)
    values, converged, status = minimize(
        program,
        unknowns.symbols,
        casadi.sum1(unknowns.durations) + settings.smoothness * smooth,
        tuple(map(unknowns.pack, LEG_SECONDS, states, (low, high))),
        unknowns.pack(guess.leg_times, guess.states, guess.commands),
        effort or Effort(),
    )
    found = unknowns.unpack(values)
    found = dataclasses.replace(found, commands=np.clip(found.commands, low, high))
    return Solution(found, converged, status, time.process_time() - began)


def _add_equations(
    program: Program,
    problem: Problem,
    dynamics: Dynamics,
    unknowns: Unknowns,
    guess: Trajectory,
    settings: Settings,
) -> None:
    """The equations of motion in all intervals, and the rules at all nodes."""
    x, u, count = unknowns.states, unknowns.commands, guess.intervals
    step = casadi.reshape(casadi.repmat(unknowns.durations.T / count, count, 1), 1, -1)
    interval = dynamics.interval(unknowns.scale, unknowns.command_scale).map(unknowns.nodes - 1)
    defect, between = interval(x[:, :-1], u[:, :-1], x[:, 1:], u[:, 1:], step)
    program.add(defect, 0.0, 0.0)
    seen = dynamics.seen.map(unknowns.nodes)(x * unknowns.scale)
    margin, walls = settings.margin, settings.walls
    add_rules(program, problem, seen[:3, :], seen[3:6, :], count, margin, walls)
    rate_limit = problem.rate_limit if settings.rate_limit is None else settings.rate_limit
    _add_limits(program, problem, rate_limit, seen, between)


def _state_bounds(
    problem: Problem, dynamics: Dynamics, nodes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (nodes, leaves) of the states: fixed constants and the start."""
    low = np.full((nodes, dynamics.state_count), -np.inf)
    high = -low
    start = leaves(problem.hover_state)
    low[:, dynamics.constant] = high[:, dynamics.constant] = start[dynamics.constant]
    if problem.start == "hover":
        low[0] = high[0] = start
    return low, high


def _add_limits(
    program: Program, problem: Problem, rate_limit: np.ndarray, seen: Any, between: Any
) -> None:
    """Body rates at all nodes, small ones also between them, and pitch at all nodes."""
    for axis, limit in enumerate(rate_limit):
        if np.isfinite(limit):
            program.add(seen[6 + axis, 1:], -limit, limit)
        if limit < SMALL_RATE:
            program.add(between[axis, :], -limit, limit)
    if np.isfinite(problem.pitch_limit):
        program.add(seen[9, 1:], -problem.pitch_limit, problem.pitch_limit)


def _add_period(
    program: Program,
    problem: Problem,
    dynamics: Dynamics,
    x: Any,
    u: Any,
    guess: Trajectory,
    scale: np.ndarray,
) -> None:
    """The end equals the start, up to multiples of 2 pi of angles and the sign of a quaternion."""
    factor, offset, kept = period(problem, guess)
    kept &= ~dynamics.constant
    rows = [index for index in range(dynamics.state_count) if kept[index]]
    program.add((x[:, -1] - factor * x[:, 0] - offset / scale)[rows], 0.0, 0.0)
    program.add(u[:, -1] - u[:, 0], 0.0, 0.0)
    quaternion = [index for index in range(dynamics.state_count) if problem.normalized[index]]
    if quaternion:
        program.add(casadi.sumsqr((x[:, 0] * scale)[quaternion]), 1.0, 1.0)


def period(problem: Problem, guess: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How the last state of a periodic flight follows from its first.

    Returns:
        Factor, offset and mask, each (leaves,): ``last = factor * first + offset``, where the mask
        is true. Of a quaternion, the largest component is left out: the norm determines it.
    """
    first, last = guess.states[0], guess.states[-1]
    angle, quaternion = problem.angles, problem.normalized
    turns = np.where(angle, 2.0 * np.pi * np.round((last - first) / (2.0 * np.pi)), 0.0)
    same = first[quaternion] @ last[quaternion] >= 0.0
    factor = np.where(quaternion & ~np.bool_(same), -1.0, 1.0)
    kept = np.ones(len(first), bool)
    if quaternion.any():
        indices = np.flatnonzero(quaternion)
        kept[indices[np.argmax(np.abs(first[quaternion]))]] = False
    return factor, turns, kept
