"""Interval arithmetic, and a bound, up to rounding, of a vehicle's largest specific force."""

import dataclasses
import math
import operator
from collections.abc import Callable

import jax
import numpy as np

from quadjax.core.errors import InputError
from quadjax.limits.jaxpr import translate
from quadjax.limits.problem import Problem, leaves

TOLERANCE = 3e-3  # relative, of the largest force
MOST_BOXES = 1_000_000
PART = 4096  # boxes that are evaluated at once
ROUNDING = 1.0 + 1e-9  # covers the rounding of some hundred operations in float64


@dataclasses.dataclass(frozen=True)
class Interval:
    """Many closed intervals [low, high], (n,) each."""

    low: np.ndarray
    high: np.ndarray

    def __add__(self, other: "Number") -> "Interval":
        low, high = _ends(other)
        return Interval(self.low + low, self.high + high)

    __radd__ = __add__

    def __neg__(self) -> "Interval":
        return Interval(-self.high, -self.low)

    def __sub__(self, other: "Number") -> "Interval":
        low, high = _ends(other)
        return Interval(self.low - high, self.high - low)

    def __rsub__(self, other: "Number") -> "Interval":
        return -self + other

    def __mul__(self, other: "Number") -> "Interval":
        ends = [a * b for a in (self.low, self.high) for b in _ends(other)]
        return Interval(np.minimum.reduce(ends), np.maximum.reduce(ends))

    __rmul__ = __mul__

    def __truediv__(self, other: "Number") -> "Interval":
        low, high = _ends(other)
        if np.any(np.asarray(low) * high <= 0.0):
            raise InputError("the largest force is not bounded: a division by zero is possible")
        return self * Interval(1.0 / np.asarray(high), 1.0 / np.asarray(low))

    def __rtruediv__(self, other: float) -> "Interval":
        return Interval(np.asarray(other), np.asarray(other)) / self


Number = float | Interval


def _ends(value: Number) -> tuple[np.ndarray | float, np.ndarray | float]:
    return (value.low, value.high) if isinstance(value, Interval) else (value, value)


def _increasing(function: Callable[..., np.ndarray]) -> Callable[[Number], Number]:
    """An increasing function of numbers, for intervals too."""

    def lifted(value: Number) -> Number:
        if isinstance(value, Interval):
            return Interval(function(value.low), function(value.high))
        return float(function(value))

    return lifted


def _square(value: Number) -> Number:
    if not isinstance(value, Interval):
        return value * value
    ends = value.low**2, value.high**2
    least = np.where((value.low <= 0) & (value.high >= 0), 0.0, np.minimum(*ends))
    return Interval(least, np.maximum(*ends))


def _absolute(value: Number) -> Number:
    if not isinstance(value, Interval):
        return abs(value)
    ends = np.abs(value.low), np.abs(value.high)
    least = np.where((value.low <= 0) & (value.high >= 0), 0.0, np.minimum(*ends))
    return Interval(least, np.maximum(*ends))


def _of_number(function: Callable[[float], float]) -> Callable[[Number], float]:
    """A function that is needed for numbers only, such as the sine of the fixed attitude."""

    def checked(value: Number) -> float:
        if isinstance(value, Interval):
            raise InputError("the largest force of this vehicle model has no interval bound")
        return function(value)

    return checked


def _angle(y: Number, x: Number) -> Number:
    """``atan2`` for x > 0; at x = 0 the limit."""
    if not isinstance(y, Interval) and not isinstance(x, Interval):
        return math.atan2(y, x)
    (y_low, y_high), (x_low, x_high) = _ends(y), _ends(x)
    if np.any(np.asarray(x_low) < 0.0):
        raise InputError("the largest force is not bounded: atan2 of a negative number")
    ends = [np.arctan2(a, b) for a in (y_low, y_high) for b in (x_low, x_high)]
    return Interval(np.minimum.reduce(ends), np.maximum.reduce(ends))


def _larger(one: Number, other: Number) -> Number:
    if not isinstance(one, Interval) and not isinstance(other, Interval):
        return max(one, other)
    pairs = zip(_ends(one), _ends(other), strict=True)
    return Interval(*(np.maximum(*pair) for pair in pairs))


def _equal(one: Number, other: Number) -> Number | bool:
    """Whether numbers are equal: 0, 1, or [0, 1] where it depends."""
    if not isinstance(one, Interval) and not isinstance(other, Interval):
        return one == other
    (low, high), (other_low, other_high) = _ends(one), _ends(other)
    least, most = np.maximum(low, other_low), np.minimum(high, other_high)
    same = np.minimum(low, other_low) == np.maximum(high, other_high)
    return Interval(np.asarray(same, float), np.asarray(least <= most, float))


def _above(compare: Callable[..., bool]) -> Callable[[Number, Number], Number | bool]:
    """Whether a number is larger than another, or at least as large; as of ``_equal``."""

    def above(one: Number, other: Number) -> Number | bool:
        if not isinstance(one, Interval) and not isinstance(other, Interval):
            return compare(one, other)
        (low, high), (other_low, other_high) = _ends(one), _ends(other)
        certain, possible = np.asarray(low > other_high), np.asarray(high >= other_low)
        return Interval(certain.astype(float), possible.astype(float))

    return above


def _where(which: Number | bool, yes: Number, no: Number) -> Number:
    if not isinstance(which, Interval):
        return yes if which else no
    (low, high), (other_low, other_high) = _ends(yes), _ends(no)
    certain, possible = which.low > 0.0, which.high > 0.0
    return Interval(
        np.where(certain, low, np.where(possible, np.minimum(low, other_low), other_low)),
        np.where(certain, high, np.where(possible, np.maximum(high, other_high), other_high)),
    )


OPERATIONS = {
    "max": _larger,
    "min": lambda one, other: -_larger(-one, -other),
    "eq": _equal,
    "ge": _above(operator.ge),
    "gt": _above(operator.gt),
    "le": lambda one, other: _above(operator.ge)(other, one),
    "lt": lambda one, other: _above(operator.gt)(other, one),
    "sign": _increasing(np.sign),
    "where": _where,
    "square": _square,
    "abs": _absolute,
    "sqrt": _increasing(np.sqrt),
    "tanh": _increasing(np.tanh),
    "atan2": _angle,
    "sin": _of_number(math.sin),
    "cos": _of_number(math.cos),
}


def gravity(problem: Problem) -> np.ndarray:
    """Gravity (3,), m/s^2, world: the acceleration at hover that no specific force explains."""
    state, model = problem.hover_at(*np.zeros((3, 3))), problem.model
    low, _ = model.command_range(problem.vehicle.constants)
    with jax.enable_x64(True):
        held = model.hold(problem.state(state), low)
        slope = model.derivative(problem.vehicle, held, low)
        force = model.specific_force(problem.vehicle, held)
    return leaves(model.velocity(slope)) - leaves(force)


def largest_force(problem: Problem, speed: float, drag: float) -> float:
    """An upper bound, m/s^2, of ``|F + drag * v|`` over actuators, attitudes and velocities.

    ``F`` is the specific force and ``v`` the velocity, of a length up to ``speed``. Branch and
    bound with interval arithmetic, relative tolerance ``TOLERANCE``; from ``MOST_BOXES`` boxes on
    none is divided further, and the bound is looser. The force may depend on the attitude only
    through the velocity in the body frame.

    Raises:
        InputError: an operation of the model without an interval bound.
    """
    function, slope, low, high = _squared_force(problem, speed, drag)
    boxes = [(low[None], high[None])]
    reached, settled = 0.0, 0.0  # value at some point; bound over the boxes that need no split
    while boxes:
        most = sum(len(lows) for lows, _ in boxes) > MOST_BOXES
        left = []
        for lows, highs in boxes:
            lows, highs, steepness = _narrowed(slope, lows, highs)
            bound, value = _bounds(function, lows, highs, steepness, speed)
            reached = max(reached, value)
            done = (bound <= reached * (1.0 + TOLERANCE) ** 2) | most
            settled = max(settled, bound[done].max(initial=0.0))
            widest = np.argmax((steepness * (highs - lows))[~done], axis=1)
            lows, highs = _split(lows[~done], highs[~done], widest)
            nearest = np.clip(0.0, lows[:, :3], highs[:, :3])
            inside = np.linalg.norm(nearest, axis=1) <= speed
            left.append((lows[inside], highs[inside]))
        boxes = _parts(*(np.concatenate(side) for side in zip(*left, strict=True)))
    return float(np.sqrt(max(settled, reached)) * ROUNDING)


def _parts(lows: np.ndarray, highs: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Boxes (n, k) in parts that fit in the processor's cache."""
    starts = range(0, len(lows), PART)
    return [(lows[index : index + PART], highs[index : index + PART]) for index in starts]


def _bounds(
    function: Callable[[Interval], Interval],
    lows: np.ndarray,
    highs: np.ndarray,
    steepness: np.ndarray,
    speed: float,
) -> tuple[np.ndarray, float]:
    """Upper bounds (n,) of a function in boxes (n, k), and its largest value in their middles."""
    middle = 0.5 * (lows + highs)
    centered = function(Interval(middle.T, middle.T)).high + (steepness * 0.5 * (highs - lows)).sum(
        axis=1
    )
    inner = middle.copy()
    length = np.linalg.norm(inner[:, :3], axis=1, keepdims=True)
    inner[:, :3] *= np.minimum(1.0, speed / np.maximum(length, 1e-9))
    value = float(function(Interval(inner.T, inner.T)).low.max())
    return np.minimum(function(Interval(lows.T, highs.T)).high, centered), value


def _narrowed(
    slope: Callable[[Interval], list[Interval]], lows: np.ndarray, highs: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Boxes without the parts that hold no maximum, and the largest slopes (n, k) in them.

    Where the function increases or decreases with an actuator's state throughout a box, its
    maximum is at that end.
    """
    slopes = slope(Interval(lows.T, highs.T))
    least = np.stack([np.broadcast_to(each.low, len(lows)) for each in slopes], axis=1)
    most = np.stack([np.broadcast_to(each.high, len(lows)) for each in slopes], axis=1)
    actuator = np.arange(lows.shape[1]) >= 3
    lows, highs = (
        np.where(actuator & (least >= 0.0), highs, lows),
        np.where(actuator & (most <= 0.0), lows, highs),
    )
    return lows, highs, np.maximum(np.abs(least), np.abs(most))


def _split(low: np.ndarray, high: np.ndarray, widest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Halves of boxes (n, k) across the sides ``widest`` (n,)."""
    rows = np.arange(len(low))
    middle = 0.5 * (low[rows, widest] + high[rows, widest])
    upper, lower = low.copy(), high.copy()
    upper[rows, widest] = lower[rows, widest] = middle
    return np.concatenate([low, upper]), np.concatenate([lower, high])


def _squared_force(
    problem: Problem, speed: float, drag: float
) -> tuple[
    Callable[[Interval], Interval], Callable[[Interval], list[Interval]], np.ndarray, np.ndarray
]:
    """``|F + drag v|^2`` of boxes of velocity and actuators, its gradient, and their ranges."""
    model = problem.model
    start = problem.hover_at(*np.zeros((3, 3)))
    reads = {name: problem.leaf_indices(name) for name in ("velocity", "actuator_state")}
    ends = model.actuator_range(problem.vehicle.constants)
    low = np.concatenate([np.full(3, -speed), leaves(ends[0])])
    high = np.concatenate([np.full(3, speed), leaves(ends[1])])
    varied = reads["velocity"] + reads["actuator_state"]

    def squared(state: object) -> jax.Array:
        force = model.specific_force(problem.vehicle, state)
        total = force + model.velocity(state) * drag
        return total.x**2 + total.y**2 + total.z**2

    scalar = translate(squared, OPERATIONS, problem.state(start))
    gradient = translate(jax.grad(squared), OPERATIONS, problem.state(start))

    def values(box: Interval) -> list[Number]:
        whole: list[Number] = [float(x) for x in start]
        for row, index in enumerate(varied):
            whole[index] = Interval(box.low[row], box.high[row])
        return whole

    def function(box: Interval) -> Interval:
        (result,) = scalar(*values(box))
        return result

    def slope(box: Interval) -> list[Interval]:
        slopes = gradient(*values(box))
        return [_interval(slopes[index]) for index in varied]

    return function, slope, low, high


def _interval(value: Number) -> Interval:
    return value if isinstance(value, Interval) else Interval(*map(np.asarray, (value, value)))
