"""Simple changes of a flight log's columns: what may be wrong with those of one quantity."""

import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

LONGEST_DELAY = 0.6  # s, that is looked for
AXES = (0, 1, 2)
MOTORS = (0, 1, 2, 3)
SCALES = 1.1 ** np.arange(-48.0, 49.0)
ANGLES = np.arange(-175.0, 181.0, 5.0)  # deg
NEGATED = "negated"
UNRELATED = "of something else"
ALONE = 6.0  # log-likelihood: the columns of a sensor are rarely late one by one


class Change(NamedTuple):
    """What may be wrong with some columns of a quantity."""

    columns: tuple[int, ...] = ()
    text: str = ""  # after the names of the columns; {0} is the name of the quantity's first one
    allowed: bool = False
    matrix: np.ndarray = np.eye(3)  # that corrects the columns
    delay: float = 0.0  # s, by which they are late
    order: tuple[int, ...] = MOTORS  # column of each motor
    spin: float = 1.0  # -1 for propellers that turn the other way
    unlikely: float = 0.0  # log-likelihood that its evidence must exceed besides


OTHER_COLUMNS = tuple(Change((i,), UNRELATED) for i in AXES)


@functools.cache
def vector_changes(scale: float, delay: float, angle: float) -> tuple[Change, ...]:
    """All changes of the columns of a vector, the simplest first.

    Args:
        scale: largest relative error that is allowed.
        delay: largest one that is allowed, s.
        angle: largest one that is allowed, deg.
    """
    delays = [_delays(columns, delay) for columns in (AXES, (0,), (1,), (2,))]
    return (*_signed(), *_scaled(1.0 + scale), *_rotated(angle), *itertools.chain(*delays))


@functools.cache
def attitude_changes(form: str, delay: float) -> tuple[Change, ...]:
    """All changes of Euler angles or of a quaternion's vector, and the inverse of a matrix."""
    if form == "rotation":
        columns = tuple(range(9))
        inverse = Change(columns, "of the inverse rotation", matrix=-np.eye(3))
        return (inverse, *_delays(columns, delay))
    return (*_signed(), *_delays(AXES, delay))


@functools.cache
def motor_changes(delay: float, speeds: bool) -> tuple[Change, ...]:
    """All orders and delays of motors; of their speeds also the other direction of propellers.

    Args:
        delay: largest one that is allowed, s.
        speeds: whether the columns are speeds, or else commands.
    """
    spin = Change(MOTORS, "of propellers that turn the other way", spin=-1.0)
    orders = [
        Change(*_reordered(order), order=order)
        for order in itertools.islice(itertools.permutations(MOTORS), 1, None)
    ]
    sizes = np.arange(0.02, LONGEST_DELAY, 0.02)  # s: the speeds change fast
    return (*[spin] * speeds, *orders, *_delayed(MOTORS, sizes, delay))


def _reordered(
    order: Sequence[int], sign: Sequence[float] = (1.0,) * 4
) -> tuple[tuple[int, ...], str]:
    """The columns that an order with signs changes, and how, as text."""
    moved = tuple(i for i, source in enumerate(order) if source != i or sign[i] < 0.0)
    if all(order[i] == i for i in moved):
        return moved, NEGATED
    if len(moved) == 2 and min(sign) > 0.0:
        return moved, "swapped"
    names = ["-" * (sign[i] < 0.0) + f"{{{order[i]}}}" for i in moved]
    return moved, f"in the order {', '.join(names)}"


def _signed() -> Iterator[Change]:
    """Every order of three columns with every sign, but that of the log."""
    signs = itertools.product((1.0, -1.0), repeat=3)
    for order, sign in itertools.product(itertools.permutations(AXES), list(signs)):
        columns, text = _reordered(order, sign)
        if columns:
            matrix = np.eye(3)[list(order)] * np.array(sign)[:, None]
            yield Change(columns, text, matrix=matrix)


def _scaled(largest: float) -> Iterator[Change]:
    """Scales of all and of single columns."""
    for columns, factor in itertools.product((AXES, (0,), (1,), (2,)), SCALES):
        matrix = np.diag([1.0 / factor if i in columns else 1.0 for i in AXES])
        text = f"{factor:.3g} times too large (logs.units, logs.max_scale_error)"
        yield Change(columns, text, 1.0 / largest <= factor <= largest, matrix)


def _rotated(largest: float) -> Iterator[Change]:
    """Rotations in each plane of two columns."""
    for columns, angle in itertools.product(itertools.combinations(AXES, 2), ANGLES):
        matrix, turn = np.eye(3), np.radians(angle)
        rotation = [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
        matrix[np.ix_(columns, columns)] = rotation
        text = f"rotated by {angle:g} deg (logs.max_angle)"
        yield Change(columns, text, abs(angle) <= largest, matrix)


def _delays(columns: tuple[int, ...], largest: float) -> Iterator[Change]:
    """Delays of smooth signals, each half as much again as the next shorter one."""
    sizes = largest * np.array([0.5, 1.0, *(1.5 * 1.4 ** np.arange(30.0))])
    return _delayed(columns, sizes[sizes <= max(LONGEST_DELAY, largest)], largest)


def _delayed(columns: tuple[int, ...], sizes: np.ndarray, largest: float) -> Iterator[Change]:
    for size, sign in itertools.product(sizes, (1.0, -1.0)):
        text = f"{size:.3g} s {'late' if sign > 0.0 else 'early'} (logs.max_delay)"
        unlikely = ALONE if len(columns) == 1 else 0.0
        delay, allowed = float(sign * size), bool(size <= largest)
        yield Change(columns, text, allowed, delay=delay, unlikely=unlikely)
