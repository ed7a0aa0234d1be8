"""A lower bound of the time of a flight, by duality; docs/design/limits.md has the proof.

The vehicle is relaxed to a point mass. The minima of the legs' times plus the multipliers' terms
add up to a lower bound for any multipliers. The largest is found by smooth maximization, and then
evaluated with a bound of every approximation.

It holds up to rounding, for flights below a given speed, where consecutive openings are apart from
each other. Models without a function in ``LARGEST_FORCES``, and those with a residual, have none.
"""

import collections
import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from scipy.optimize import minimize

from quadjax.core.errors import InputError
from quadjax.limits.problem import POSITION, Problem

COARSE = 400  # durations of a leg during maximization
FINE = 4000  # cells of durations in the evaluation
PIECES = 64  # of a leg's multiplier
SOFTNESS = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4)  # s, of the smoothed minimum
DRAGS = (1e-3, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4)  # 1/s, tried
TOUCHING = 1e-6  # m, distance of openings below which a leg has no shortest duration
CELLS = (200, 1000)  # of rotor speeds, and of vertical velocity
ROUNDING = 1.0 + 1e-9  # covers the rounding of some hundred operations in float64
Constants = Mapping[str, float]


@struct.dataclass
class PointMass:
    """The relaxation: ``p'' = gravity + f - drag * p'``, ``|f| <= force``, ``|p'| <= speed``."""

    force: float  # m/s^2
    drag: float  # 1/s, above 0
    gravity: np.ndarray  # (3,) m/s^2
    speed: float  # m/s


@struct.dataclass
class Course:
    """Legs between convex sets of points; world NED, m."""

    starts: np.ndarray  # (legs, corners, 3) of the sets in which the legs begin
    ends: np.ndarray  # (legs, corners, 3)
    periodic: bool = struct.field(pytree_node=False)  # else from rest in a point
    stops: bool = struct.field(pytree_node=False)  # ends at rest


class LowerBound(NamedTuple):
    """A lower bound of the time of every flight below a speed, up to rounding; or why none."""

    time: float | None  # s
    speed: float  # m/s
    error: str = ""


def lower_bound(problem: Problem, speed: float, longest: float) -> LowerBound:
    """A lower bound of the time of every flight that never exceeds a speed, m/s.

    It is at most ``longest``, s, a time that some flight achieves.
    """
    vehicle, name, stops = problem.params.vehicle, problem.model.name, problem.flight.stops
    if vehicle.residual is not None or name not in LARGEST_FORCES:
        return LowerBound(None, speed, "the largest force of this vehicle model has no bound")
    values = vars(vehicle.constants).items()
    constants = {key: float(x) for key, x in values if not dataclasses.is_dataclass(x)}
    points = [problem.gates.corners(gate, problem.flight.clearance) for gate in problem.order]
    if stops:
        points[-1] = problem.gates.corners(problem.order[-1], None)
    course = make_course(points, None if problem.periodic else problem.start[POSITION], stops)
    best, multipliers, gravity = 0.0, None, np.array([0.0, 0.0, constants["g"]])
    for drag in DRAGS:
        mass = PointMass(largest_force(name, constants, speed, drag), drag, gravity, speed)
        try:
            time, multipliers = maximize(course, mass, longest, multipliers)
        except InputError as error:
            return LowerBound(None, speed, str(error))
        if time <= best:
            break
        best = time
    return LowerBound(best, speed)


def make_course(
    points: Sequence[np.ndarray], start: np.ndarray | None = None, stops: bool = False
) -> Course:
    """The legs between points to pass in order: the corners (n, 3) of each gate's opening, m.

    A flight begins at rest at ``start`` (3,); None: a periodic one. It ``stops`` at rest, or not.
    """
    count = max(map(len, points))
    sets = np.stack([x[np.minimum(np.arange(count), len(x) - 1)] for x in points])
    starts = np.roll(sets, 1, axis=0)
    if start is not None:
        starts[0] = start
    return Course(starts, sets, start is None, stops)


def largest_force(name: str, constants: Constants, speed: float, drag: float) -> float:
    """An upper bound, m/s^2, of ``|F + drag * v|`` over actuators, attitudes and velocities.

    ``F`` is the specific force of a model and ``v`` the velocity, of a length up to ``speed``.
    """
    return float(LARGEST_FORCES[name](constants, speed, drag)) * ROUNDING


def _rate(c: Constants, speed: float, drag: float) -> float:
    """Linear drag along x and y: a quadratic function of the vertical velocity."""
    side, thrust = max(abs(drag - c["d_x"]), abs(drag - c["d_y"])) ** 2, c["thrust_max"]
    concave = max(side - drag**2, 1e-300)
    vertical = np.array([0.0, min(drag * thrust / concave, speed), speed])
    return float(np.sqrt((side * (speed**2 - vertical**2) + (drag * vertical + thrust) ** 2).max()))


def _rotors(c: Constants, speed: float, drag: float) -> float:
    """The terms of ``motor``, ``racing`` and ``a2rl``, in cells of rotor speeds and velocity."""
    k = collections.defaultdict(float, c)  # terms that a model lacks are zero
    low, high = (c.get(f"w_{end}", c.get(f"rpm_{end}", 0.0)) for end in ("min", "max"))
    totals = np.linspace(4.0 * low, 4.0 * high, CELLS[0] + 1)[:, None]
    speeds = np.linspace(0.0, speed, CELLS[1] + 1)
    total, vertical = (totals[:-1], totals[1:]), (speeds[:-1], speeds[1:])  # ends of the cells
    square = speed**2 - vertical[0] ** 2  # of the horizontal speed, at most
    axes = (k["k_x"], k["k_x2"]), (k["k_y"], k["k_y2"])
    cases = itertools.product(total, (np.zeros(1), np.sqrt(square)))
    slopes = [np.abs(drag - one * t - two * h) for t, h in cases for one, two in axes]
    side = np.maximum.reduce(np.broadcast_arrays(*slopes)) ** 2 * square
    # Each rotor's speed is in its range: the sum of squares is at most linear in the sum.
    thrust = k["k_w"] * ((low + high) * total[1] - 4.0 * low * high)
    tip = [0.25 * k["rotor_radius"] * t + 1e-300 for t in total]
    advance = k["k_hor"] * np.arctan2(square, tip[0] ** 2)
    largest = 0.0
    for sign in (1.0, -1.0):  # of the vertical velocity
        angles = [sign * k["k_angle"] * np.arctan2(v, t) for v in vertical for t in tip]
        gain = 1.0 + np.maximum.reduce(angles) + np.maximum(advance, 0.0)
        loss = -1.0 - np.minimum.reduce(angles) - np.minimum(advance, 0.0)
        rows = itertools.product(total, vertical, vertical)
        others = [sign * (k["k_z"] * t + k["k_v2"] * v - drag) * w for t, v, w in rows]
        up = thrust * np.maximum(gain, 0.0) + np.maximum.reduce(others)
        down = thrust * np.maximum(loss, 0.0) - np.minimum.reduce(others)
        along = np.maximum(up, down) + abs(k["k_h"]) * square
        largest = max(largest, float((side + along**2).max()))
    return float(np.sqrt(largest))


LARGEST_FORCES: dict[str, Callable[[Constants, float, float], float]] = {
    "rate": _rate,
    "rotor_thrust": lambda c, speed, drag: 4.0 * c["thrust_max"] / c["mass"] + drag * speed,
    "motor": _rotors,
    "racing": _rotors,
    "a2rl": _rotors,
}


def maximize(
    course: Course, mass: PointMass, longest: float, start: np.ndarray | None = None
) -> tuple[float, np.ndarray]:
    """The largest bound, s, at most ``longest``, and its multipliers; ``start`` are the first ones.

    Raises:
        InputError: two consecutive openings touch, so that a leg may have any short duration.
    """
    gaps = np.array([_distance(*pair) for pair in zip(course.starts, course.ends, strict=True)])
    if gaps.min() < TOUCHING:
        raise InputError(
            f"leg {gaps.argmin() + 1} begins in an opening that touches the next one; a lower "
            "bound needs openings apart from each other"
        )
    ends = np.geomspace(gaps / mass.speed, longest, FINE + 1, axis=1)
    grid = np.geomspace(gaps / mass.speed, longest, COARSE, axis=1)
    with jax.enable_x64(True):

        def negative(x: np.ndarray, softness: float) -> tuple[float, np.ndarray]:
            value, slope = _softened(jnp.asarray(x), course, mass, softness, grid)
            return float(value), np.asarray(slope)

        x = _first(course, mass) if start is None else start
        best, best_x = float(_proven(jnp.asarray(x), course, mass, ends)), x
        options = {"maxiter": 400, "maxfun": 800, "maxcor": 30}
        for softness in SOFTNESS:
            x = minimize(negative, x, softness, method="L-BFGS-B", jac=True, options=options).x
            value = float(_proven(jnp.asarray(x), course, mass, ends))
            if value > best:
                best, best_x = value, x
    return min(best, longest), best_x


def _distance(before: np.ndarray, after: np.ndarray) -> float:
    """A lower bound of the distance between two openings, m.

    The widest gap between their corners along the axes and the lines that join two corners.
    """
    ways = (after[:, None] - before[None]).reshape(-1, 3)
    ways = np.concatenate([np.eye(3), -np.eye(3), ways[np.linalg.norm(ways, axis=1) > TOUCHING]])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return float(((after @ ways.T).min(axis=0) - (before @ ways.T).max(axis=0)).max())


def _first(course: Course, mass: PointMass) -> np.ndarray:
    """Multipliers of a flight that turns at every gate with the largest force."""
    before, here = course.starts.mean(axis=1), course.ends.mean(axis=1)
    after = np.roll(here, -1, axis=0)
    ways = before + after - 2.0 * here
    if not course.periodic:
        ways[-1] = before[-1] - here[-1]
        ways = np.concatenate([ways, (here - before)[:1]])
    side = np.sqrt(max(mass.force**2 - mass.gravity @ mass.gravity, 1.0))
    ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-6)
    force = side * ways - mass.gravity
    rows = -0.5 / mass.force * force / np.linalg.norm(force, axis=1, keepdims=True)
    velocity, start = rows[: len(here)], rows[len(here) :]
    return np.concatenate([velocity.ravel(), np.zeros(velocity.size), start.ravel()])


def _multipliers(course: Course, x: jax.Array) -> tuple[jax.Array, ...]:
    """Multipliers (legs, 3): velocity at each leg's start and end, position at start and end."""
    count = len(course.starts)
    velocity, position = x[: 6 * count].reshape(2, count, 3)
    first_velocity, first_position = velocity[-1], position[-1]
    if not course.periodic:
        first_velocity, first_position = x[6 * count :], jnp.zeros(3)
        position = position.at[-1].set(0.0)
        velocity = velocity if course.stops else velocity.at[-1].set(0.0)
    start_velocity = jnp.concatenate([first_velocity[None], velocity[:-1]])
    start_position = jnp.concatenate([first_position[None], position[:-1]])
    return start_velocity, velocity, start_position, position


@jax.jit
@jax.value_and_grad
def _softened(
    x: jax.Array, course: Course, mass: PointMass, softness: float, grid: jax.Array
) -> jax.Array:
    """Minus the sum of the legs' smoothed minima over durations (legs, n); with its gradient."""
    values = _values(course, mass, _multipliers(course, x), grid).reshape(len(grid), -1)
    return softness * jax.nn.logsumexp(-values / softness, axis=1).sum()


@jax.jit
def _proven(x: jax.Array, course: Course, mass: PointMass, ends: jax.Array) -> jax.Array:
    """The bound of given multipliers, s, with every approximation on the safe side.

    In each cell of durations, between two of (legs, n) ``ends``, the value in the middle is reduced
    by half the cell's width times a bound of the slope.
    """
    sides, low, high = _multipliers(course, x), ends[:, :-1], ends[:, 1:]
    values = _values(course, mass, sides, 0.5 * (low + high)).min(axis=2)
    change, drag = sides[1] - sides[0], mass.drag
    way = course.ends[:, None, :, :] - course.starts[:, :, None, :]
    farthest = jnp.abs(jnp.einsum("lc,labc->lab", change, way)).max(axis=(1, 2))[:, None]
    inverse = jnp.exp(drag * low) / jnp.expm1(drag * low) ** 2
    supports = jnp.stack([_support(mass, sides[0]), _support(mass, sides[1])])
    direct = jnp.abs(1.0 - supports).max(axis=0)[:, None]
    reach = (mass.force + jnp.linalg.norm(mass.gravity)) * jnp.linalg.norm(change, axis=1)
    slope = direct + reach[:, None] * (drag * high + 1.0) + drag**2 * farthest * inverse
    return (values - 0.5 * (high - low) * slope).min(axis=1).sum() * (1.0 - 1e-9)


def _support(mass: PointMass, direction: jax.Array) -> jax.Array:
    """The largest ``-direction . (g + f)`` over the forces ``f``."""
    length = jnp.sqrt(jnp.sum(direction * direction, axis=-1) + 1e-18)
    return mass.force * length - direction @ mass.gravity


def _values(
    course: Course, mass: PointMass, sides: tuple[jax.Array, ...], times: jax.Array
) -> jax.Array:
    """Lower bounds (legs, times, pairs of corners) of each leg's minimum at durations, s."""
    first, last, here, there = sides
    change = last - first
    share = jnp.linspace(0.0, 1.0, PIECES + 1)
    support = _support(mass, first[:, None] + share[:, None] * change[:, None])
    growth = jnp.expm1(mass.drag * times)[..., None]
    when = jnp.log1p(share * growth) / mass.drag  # s, when the multiplier has changed by `share`
    # The support is convex: its chords are above it, and are integrated exactly.
    width = jnp.diff(when, axis=-1)
    moment = share[1:] - share[:-1]
    mean = moment / mass.drag - width / growth  # the integral of `share` over a piece, s
    slope = jnp.diff(support, axis=-1)[:, None] / moment
    lost = (support[:, None, :-1] - slope * share[:-1]) * width + slope * mean
    way = course.ends[:, None, :, :] - course.starts[:, :, None, :]
    pull = jnp.einsum("lc,labc->lab", change, way)[:, None] / growth[..., None]
    push = jnp.einsum("lc,labc->lab", first, way)[:, None]
    place = jnp.einsum("lc,lbc->lb", there, course.ends)[:, None, None, :]
    place = place - jnp.einsum("lc,lac->la", here, course.starts)[:, None, :, None]
    values = (times - lost.sum(axis=-1))[..., None, None] + mass.drag * (pull - push) + place
    return values.reshape(*times.shape, -1)
