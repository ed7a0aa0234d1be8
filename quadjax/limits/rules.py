"""The rules of a race as constraints of a nonlinear program."""

import dataclasses
from typing import Any

import numpy as np

from quadjax.limits.extra import casadi
from quadjax.limits.ipopt import Program
from quadjax.limits.problem import Problem
from quadjax.race.rules import BENEATH

SLOWEST_PASSAGE = 0.2  # m/s, smallest speed through a gate
BEYOND = 1e-5  # m beyond the gate's plane, at the end of a leg; much less than any margin


@dataclasses.dataclass(frozen=True)
class Wall:
    """A side of a gate's solid frame, beyond which the nodes of a part of the flight stay."""

    legs: tuple[float, float]  # the part, in legs since the start
    gate: int
    axis: int  # of ``Gates.axes``
    sign: float  # 1 or -1
    distance: float  # m from the gate's center


def add_rules(
    program: Program,
    problem: Problem,
    position: Any,
    velocity: Any,
    count: int,
    margin: float,
    walls: tuple[Wall, ...] = (),
) -> None:
    """Gates at the ends of the legs; bounds, ground and speed at all nodes.

    Args:
        program: gets the constraints.
        problem: the flight.
        position: (3, nodes) m.
        velocity: (3, nodes) m/s.
        count: intervals of a leg.
        margin: m, further distance from the edges of the openings, the bounds and the ground.
        walls: sides of other gates' frames.
    """
    low, high = problem.bounds
    center = problem.gates.position[problem.order[-1]]
    last = position.shape[1] - 1 if problem.stops else position.shape[1]
    for axis in range(3):
        program.add(position[axis, 1:last], low[axis] + margin, high[axis] - margin)
    program.add(casadi.sum1(velocity[:, 1:] ** 2), 0.0, problem.speed_limit**2)
    _add_ground(program, problem, position, velocity, count, margin)
    for leg, gate in enumerate(problem.order):
        node = (leg + 1) * count
        if problem.stops and leg + 1 == problem.passages:
            program.add(position[:, node] - center, 0.0, 0.0)
            program.add(velocity[:, node], 0.0, 0.0)
        else:
            _add_gate(program, problem, gate, position[:, node], velocity[:, node], margin)
    for wall in walls:
        axes, nodes = problem.gates.axes[wall.gate], np.arange(position.shape[1]) / count
        (inside,) = np.nonzero((nodes >= wall.legs[0]) & (nodes <= wall.legs[1]))
        offset = position[:, inside.tolist()] - problem.gates.position[wall.gate]
        ahead = wall.sign * casadi.mtimes(axes[wall.axis][None], offset)
        program.add(ahead, wall.distance + margin, np.inf)


def _add_ground(
    program: Program, problem: Problem, position: Any, velocity: Any, count: int, margin: float
) -> None:
    """Slow flight near the ground: on the first leg after a start there, elsewhere none."""
    if problem.landing is None:
        return
    height, speed = float(problem.landing.height), float(problem.landing.speed)
    first = count if problem.start == "hover" else 0
    program.add(position[2, first + 1 :], -np.inf, -height - margin)
    if first:
        slope = speed**2 / (height + BENEATH)  # at BENEATH no speed is left
        allowed = speed**2 - slope * (position[2, 1 : first + 1] + height)
        program.add(casadi.sum1(velocity[:, 1 : first + 1] ** 2) - allowed, -np.inf, 0.0)


def _add_gate(
    program: Program, problem: Problem, gate: int, place: Any, velocity: Any, margin: float
) -> None:
    """The passage of one gate at one node."""
    gates = problem.gates
    offset = place - gates.position[gate]
    clearance = None if problem.clearance is None else problem.clearance + margin
    if gates.waypoint is not None:
        radius = 0.0 if clearance is None else gates.waypoint - clearance
        if radius <= 0.0:
            program.add(offset, 0.0, 0.0)
        else:
            program.add(casadi.sumsqr(offset) / radius**2, 0.0, 1.0)
        return
    local, speed = (casadi.mtimes(gates.axes[gate], each) for each in (offset, velocity))
    program.add(local[0], BEYOND, BEYOND)
    program.add(speed[0], SLOWEST_PASSAGE, np.inf)
    places = [(local, offset)]
    if problem.frame is not None and clearance is not None and not gates.world_box:
        # Through the depth of the frame, along the velocity.
        depth = 0.5 * float(problem.frame.depth) + problem.radius
        way = depth / speed[0] * speed
        places = [(local - way, None), (local + way, None)]
    half = np.zeros(2) if clearance is None else gates.half_size[gate] - clearance
    half = np.maximum(half, 0.0)
    for inside, world in places:
        if gates.world_box and clearance is not None:
            program.add(world, -half[[0, 0, 1]], half[[0, 0, 1]])
        elif gates.circle[gate] and half[0] > 0.0:
            program.add(casadi.sumsqr(inside[1:]) / half[0] ** 2, 0.0, 1.0)
        else:
            program.add(inside[1:], -half, half)
