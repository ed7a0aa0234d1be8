"""Simple changes of a flight log's columns: what may be wrong with those of one quantity."""

import functools
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

LONGEST_DELAY = 0.6  # s, that is looked for
AXES = (0, 1, 2)
MOTORS = (0, 1, 2, 3)
ORDERS = tuple(itertools.permutations(MOTORS))
SIGNS = np.array(list(itertools.product((1.0, -1.0), repeat=3)))
SIGNED = np.concatenate(
    [np.eye(3)[list(p)] * SIGNS[:, :, None] for p in itertools.permutations(AXES)]
)
SCALES = 1.1 ** np.arange(-48.0, 49.0)
ANGLES = np.arange(-175.0, 181.0, 5.0)  # deg
NEGATED = "negated"
UNRELATED = "of something else"
ALONE = 6.0  # log-likelihood: the columns of a sensor are rarely late one by one
Names = tuple[str, ...]


class Limits(NamedTuple):
    """Largest errors that are allowed, of the section ``logs``."""

    scale: float  # relative
    delay: float  # s
    angle: float  # deg


@dataclass(frozen=True)
class Change:
    """What may be wrong with some columns of a quantity."""

    quantity: str
    columns: tuple[int, ...]
    text: str = ""  # after the names of the columns
    allowed: bool = False
    matrix: np.ndarray = field(default_factory=lambda: np.eye(3))  # that corrects the columns
    delay: float = 0.0  # s, by which they are late
    order: tuple[int, ...] = MOTORS  # column of each motor
    spin: float = 1.0  # -1 for propellers that turn the other way
    unlikely: float = 0.0  # log-likelihood that its evidence must exceed besides


@functools.cache
def vector_changes(quantity: str, names: Names, limits: Limits) -> tuple[Change, ...]:
    """All changes of the columns of a vector, the simplest first."""
    delays = [_delays(quantity, columns, limits) for columns in (AXES, (0,), (1,), (2,))]
    scaled = (replace(change, quantity=quantity) for change in _scaled(limits))
    return (*_signed(quantity, names), *scaled, *itertools.chain(*delays))


@functools.cache
def attitude_changes(form: str, names: Names, limits: Limits) -> tuple[Change, ...]:
    """All changes of Euler angles or of a quaternion's vector, and the inverse of a matrix."""
    if form == "rotation":
        columns = tuple(range(9))
        inverse = Change("attitude", columns, "of the inverse rotation", matrix=-np.eye(3))
        return (inverse, *_delays("attitude", columns, limits))
    return (*_signed("attitude", names), *_delays("attitude", AXES, limits))


@functools.cache
def motor_changes(
    quantity: str, names: Names, limits: Limits, slack: float = 0.0
) -> tuple[Change, ...]:
    """All orders and delays of motors.

    Args:
        quantity: of speeds or commands.
        names: of its four columns.
        limits: of the delay.
        slack: s, by which more is allowed.
    """
    changes = []
    for order in ORDERS[1:]:
        moved = tuple(i for i in MOTORS if order[i] != i)
        text = _swapped([names[order[i]] for i in moved], len(moved) == 2)
        changes.append(Change(quantity, moved, text, order=order))
    sizes = np.arange(0.02, LONGEST_DELAY, 0.02)  # s: the speeds change fast
    return (*changes, *_delayed(quantity, MOTORS, sizes, limits.delay + slack))


def other_propellers(quantity: str) -> Change:
    """The other direction of all propellers."""
    return Change(quantity, MOTORS, "of propellers that turn the other way", spin=-1.0)


@functools.cache
def unrelated(quantity: str) -> tuple[Change, ...]:
    """Each column of a vector contains something else than the vector."""
    return tuple(Change(quantity, (i,), UNRELATED) for i in AXES)


def _swapped(names: list[str], plainly: bool) -> str:
    return "swapped" if plainly else f"in the order {', '.join(names)}"


def _signed(quantity: str, names: Names) -> Iterator[Change]:
    """Every order of three columns with every sign, but that of the log."""
    for matrix in SIGNED[1:]:
        source, sign = np.abs(matrix).argmax(axis=1), matrix.sum(axis=1)
        moved = tuple(i for i in AXES if source[i] != i or sign[i] < 0.0)
        order = ["-" * int(sign[i] < 0.0) + names[source[i]] for i in moved]
        plainly = len(moved) == 2 and (sign > 0.0).all()
        text = NEGATED if (source == AXES).all() else _swapped(order, plainly)
        yield Change(quantity, moved, text, matrix=matrix)


@functools.cache
def _scaled(limits: Limits) -> tuple[Change, ...]:
    """Scales of all and of single columns, and rotations in each plane of two."""
    changes, largest = [], 1.0 + limits.scale
    for columns, factor in itertools.product((AXES, (0,), (1,), (2,)), SCALES):
        matrix = np.diag([1.0 / factor if i in columns else 1.0 for i in AXES])
        text = f"{factor:.3g} times too large (logs.units, logs.max_scale_error)"
        changes.append(Change("", columns, text, 1.0 / largest <= factor <= largest, matrix))
    for (i, k), angle in itertools.product(itertools.combinations(AXES, 2), ANGLES):
        matrix, turn = np.eye(3), np.radians(angle)
        matrix[[i, k], [i, k]] = np.cos(turn)
        matrix[i, k], matrix[k, i] = np.sin(turn), -np.sin(turn)
        text = f"rotated by {angle:g} deg (logs.max_angle)"
        changes.append(Change("", (i, k), text, abs(angle) <= limits.angle, matrix))
    return tuple(changes)


def _delays(quantity: str, columns: tuple[int, ...], limits: Limits) -> Iterator[Change]:
    """Delays of smooth signals, each half as much again as the next shorter one."""
    sizes = limits.delay * np.array([0.5, 1.0, *(1.5 * 1.4 ** np.arange(30.0))])
    longest = max(LONGEST_DELAY, limits.delay)
    return _delayed(quantity, columns, sizes[sizes <= longest], limits.delay)


def _delayed(
    quantity: str, columns: tuple[int, ...], sizes: np.ndarray, limit: float
) -> Iterator[Change]:
    for size, sign in itertools.product(sizes, (1.0, -1.0)):
        text = f"{size:.3g} s {'late' if sign > 0.0 else 'early'} (logs.max_delay)"
        unlikely = ALONE if len(columns) == 1 else 0.0
        delay, allowed = float(sign * size), bool(size <= limit)
        yield Change(quantity, columns, text, allowed, delay=delay, unlikely=unlikely)
