"""The rules of a race as constraints of a nonlinear program."""

from typing import Any

import numpy as np

from quadjax.limits.problem import Problem
from quadjax.limits.translate import casadi
from quadjax.race.rules import BENEATH

SLOWEST_PASSAGE = 0.2  # m/s, smallest speed through a gate
BEYOND = 1e-5  # m beyond the gate's plane, at the end of a leg; much less than any margin


def bound(program: Any, expression: Any, low: Any, high: Any) -> None:
    """Add ``low <= expression <= high``, which broadcast to the shape of the expression."""
    ends = (np.broadcast_to(np.asarray(end, float), expression.shape) for end in (low, high))
    low, high = (casadi.DM(end.ravel("F")) for end in ends)
    program.subject_to(program.bounded(low, casadi.vec(expression), high))


def add_rules(program: Any, problem: Problem, position: Any, velocity: Any, margin: float) -> None:
    """Gates at the ends of the legs; bounds, ground and speed at all nodes.

    Args:
        program: gets the constraints.
        problem: the flight.
        position: (3, nodes) m.
        velocity: (3, nodes) m/s.
        margin: m, further distance from the edges of the openings, the bounds and the ground.
    """
    stops, nodes, legs = problem.flight.stops, position.shape[1], len(problem.order)
    count, (low, high) = (nodes - 1) // legs, problem.bounds[..., None]
    bound(program, position[:, 1 : nodes - stops], low + margin, high - margin)
    bound(program, casadi.sum1(velocity[:, 1:] ** 2), -np.inf, problem.speed_limit**2)
    if problem.landing is not None:
        _add_ground(program, problem, position, velocity, margin)
    for leg, gate in enumerate(problem.order, 1):
        place, speed = position[:, leg * count], velocity[:, leg * count]
        if stops and leg == legs:
            bound(program, place, *[problem.gates.position[gate][:, None]] * 2)
            bound(program, speed, 0.0, 0.0)
        else:
            _add_gate(program, problem, gate, place, speed, margin)


def _add_ground(
    program: Any, problem: Problem, position: Any, velocity: Any, margin: float
) -> None:
    """Slow flight near the ground: on the first leg after a start there, elsewhere none."""
    assert problem.landing is not None
    (height, speed), count = problem.landing, (position.shape[1] - 1) // len(problem.order)
    first = 1 if problem.periodic else 1 + count
    bound(program, position[2, first:], -np.inf, -height - margin)
    if not problem.periodic:
        slope = speed**2 / (height + BENEATH)  # at BENEATH no speed is left
        allowed = speed**2 - slope * (position[2, 1:first] + height)
        bound(program, casadi.sum1(velocity[:, 1:first] ** 2) - allowed, -np.inf, 0.0)


def _add_gate(
    program: Any, problem: Problem, gate: int, place: Any, velocity: Any, margin: float
) -> None:
    """The passage of one gate at one node."""
    gates, clearance = problem.gates, problem.flight.clearance
    offset = place - gates.position[gate]
    local, speed = (casadi.mtimes(gates.axes[gate], each) for each in (offset, velocity))
    bound(program, local[0], BEYOND, BEYOND)
    bound(program, speed[0], SLOWEST_PASSAGE, np.inf)
    if clearance is None:
        bound(program, local[1:], 0.0, 0.0)
        return
    places = [local]
    if problem.frame_depth is not None:  # through it, along the velocity
        way = problem.frame_depth / speed[0] * speed
        places = [local - way, local + way]
    half = np.maximum(gates.half_size[gate] - clearance - margin, 0.0)[:, None]
    for inside in places:
        if gates.circle[gate] and half[0] > 0.0:
            bound(program, casadi.sumsqr(inside[1:]) / half[0] ** 2, -np.inf, 1.0)
        else:
            bound(program, inside[1:], -half, half)
