"""A lower bound of the time of a flight, by duality; docs/design/limits.md has the proof.

The vehicle is relaxed to a point mass ``p'' = g + f - drag * p'`` with ``|f| <= force``. The time
of a leg plus the multipliers' terms has a minimum over all flights of the relaxation; the sum of
these minima over the legs is a lower bound for any multipliers. The largest such bound is found by
smooth maximization, and then evaluated with a bound of every approximation.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from quadjax.core.errors import InputError
from quadjax.limits.dual import Numbers, cells, softened
from quadjax.limits.intervals import gravity, largest_force
from quadjax.limits.problem import Problem, leaves

COARSE = 400  # durations of a leg during maximization
FINE = 4000  # cells of durations in the evaluation
SOFTNESS = (3e-2, 1e-2, 3e-3, 1e-3, 3e-4)  # s, of the smoothed minimum
DRAGS = (1e-3, 0.2, 0.4, 0.6, 0.8, 1.0, 1.2, 1.4)  # 1/s, tried
LEAST_DRAG = 1e-3
TOUCHING = 1e-6  # m, distance of openings below which a leg has no shortest duration


@dataclasses.dataclass(frozen=True)
class PointMass:
    """The relaxation: ``p'' = gravity + f - drag * p'``, ``|f| <= force``, ``|p'| <= speed``."""

    force: float  # m/s^2
    drag: float  # 1/s, above 0
    gravity: np.ndarray  # (3,) m/s^2
    speed: float  # m/s


@dataclasses.dataclass(frozen=True)
class Course:
    """Points to pass in order. World NED.

    Attributes:
        points: for each gate the corners (n, 3) of its opening, m; without the start.
        start: (3,) m, where the flight begins at rest; None for a periodic one.
        stops: whether the flight ends at rest.
    """

    points: tuple[np.ndarray, ...]
    start: np.ndarray | None = None
    stops: bool = False


@dataclasses.dataclass(frozen=True)
class LowerBound:
    """A lower bound of the time of every flight slower than ``mass.speed``, up to rounding."""

    time: float  # s
    mass: PointMass


def course_of(problem: Problem) -> Course:
    """The gates of a flight as convex sets."""
    points = [problem.gates.shrunk(index, problem.clearance) for index in problem.order]
    start = None
    if problem.start == "hover":
        start = leaves(problem.model.position(problem.hover_state))
    if problem.stops:
        points[-1] = problem.gates.position[problem.order[-1]][None]
    return Course(tuple(points), start, problem.stops)


def lower_bound(problem: Problem, speed: float, longest: float) -> LowerBound:
    """A lower bound of the time of every flight that never exceeds a speed.

    Args:
        problem: the flight.
        speed: m/s.
        longest: s, a time that some flight achieves; the bound is at most this.

    Raises:
        InputError: the largest force of the vehicle has no bound, or two consecutive openings
            touch.
    """
    weight, course = gravity(problem), course_of(problem)
    best = LowerBound(0.0, PointMass(np.inf, LEAST_DRAG, weight, speed))
    start = None
    for drag in DRAGS:
        mass = PointMass(largest_force(problem, speed, drag), drag, weight, speed)
        found, start = maximize(course, mass, longest, start)
        if found <= best.time:
            break
        best = LowerBound(found, mass)
    return best


def maximize(
    course: Course, mass: PointMass, longest: float, start: np.ndarray | None = None
) -> tuple[float, np.ndarray]:
    """The largest bound over the multipliers.

    Args:
        course: the points to pass.
        mass: the relaxation.
        longest: s, as of ``lower_bound``.
        start: (variables,) first multipliers, a result of this function.

    Returns:
        The bound, s, and the multipliers.

    Raises:
        InputError: two consecutive openings touch, so that a leg may have any short duration.
    """
    legs = _Legs(course, mass, longest)
    x = legs.first() if start is None else start
    best, best_x = legs.evaluate(x), x
    for softness in SOFTNESS:
        found = minimize(
            lambda values, s=softness: legs.softened(values, s),
            x,
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": 400, "maxfun": 800, "maxcor": 30},
        )
        x = found.x
        value = legs.evaluate(x)
        if value > best:
            best, best_x = value, x
    return min(best, longest), best_x


class _Legs:
    """The legs of a course and their minima for given multipliers."""

    def __init__(self, course: Course, mass: PointMass, longest: float) -> None:
        self.course, self.mass = course, mass
        self.periodic = course.start is None
        points = list(course.points)
        self.before = [points[-1], *points[:-1]]
        if course.start is not None:
            self.before[0] = course.start[None]
        self.after = points
        count = max(len(each) for each in points)
        ends = (
            np.stack([np.concatenate([each, each[[-1] * (count - len(each))]]) for each in side])
            for side in (self.before, self.after)
        )
        self.numbers = Numbers(mass.force, mass.drag, mass.gravity, *ends)
        gap = np.array([_distance(a, b) for a, b in zip(self.before, self.after, strict=True)])
        if gap.min() < TOUCHING:
            raise InputError(
                f"leg {gap.argmin() + 1} begins in an opening that touches the next one; a lower "
                "bound needs openings apart from each other"
            )
        self.shortest = gap / mass.speed
        self.longest = longest

    @property
    def count(self) -> int:
        """The number of legs."""
        return len(self.after)

    def first(self) -> np.ndarray:
        """Multipliers of a flight that turns at every gate with the largest force."""
        here, there = (
            np.stack([each.mean(axis=0) for each in side]) for side in (self.before, self.after)
        )
        following = np.roll(there, -1, axis=0)
        if not self.periodic:
            following[-1] = there[-1]
        velocity = self._costate(here + following - 2.0 * there)
        first = np.zeros(0) if self.periodic else self._costate((there - here)[:1]).ravel()
        return np.concatenate([velocity.ravel(), np.zeros(3 * self.count), first])

    def _costate(self, way: np.ndarray) -> np.ndarray:
        """Multipliers (n, 3) of accelerations along ``way`` (n, 3)."""
        mass = self.mass
        side = np.sqrt(max(mass.force**2 - mass.gravity @ mass.gravity, 1.0))
        size = np.linalg.norm(way, axis=1, keepdims=True)
        force = way / np.maximum(size, 1e-6) * side - mass.gravity
        return -0.5 / mass.force * force / np.linalg.norm(force, axis=1, keepdims=True)

    def softened(self, x: np.ndarray, softness: float) -> tuple[float, np.ndarray]:
        """Minus the bound with smoothed minima, and its gradient."""
        with jax.enable_x64(True):
            grid = np.geomspace(self.shortest, self.longest, COARSE, axis=1)
            value, slope = softened(
                self.periodic, self.course.stops, self.numbers, jnp.asarray(x), softness, grid
            )
            return float(value), np.asarray(slope)

    def evaluate(self, x: np.ndarray) -> float:
        """The bound of given multipliers, s, with every approximation on the safe side."""
        with jax.enable_x64(True):
            ends = np.geomspace(self.shortest, self.longest, FINE + 1, axis=1)
            low, high = ends[:, :-1], ends[:, 1:]
            values, steepest = map(
                np.asarray,
                cells(self.periodic, self.course.stops, self.numbers, jnp.asarray(x), low, high),
            )
        least = values.min(axis=2) - 0.5 * (high - low) * steepest
        return float(least.min(axis=1).sum() * (1.0 - 1e-9))


def _distance(before: np.ndarray, after: np.ndarray) -> float:
    """A lower bound of the distance between two openings, m: the widest gap between their corners.

    The gap is measured along the axes and along the lines that join two corners.
    """
    ways = (after[:, None] - before[None]).reshape(-1, 3)
    ways = np.concatenate([np.eye(3), -np.eye(3), ways[np.linalg.norm(ways, axis=1) > TOUCHING]])
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return float(((after @ ways.T).min(axis=0) - (before @ ways.T).max(axis=0)).max())
