"""Consistency of a flight log's columns with one another, by one principle.

Kinematics and Newton's law relate the quantities of a log. A log is rejected when one simple change
of the columns of one quantity (negated or permuted axes or motors, a scale, a delay, a rotation, a
column of something else) explains it much better than the columns as logged. The measure is the
gain of the log-likelihood over that of the best change within ``logs.max_scale_error``,
``logs.max_delay`` and ``logs.max_angle``. A column is not checked if its negation or its absence
costs little likelihood, or a motor if its exchange does.
"""

import functools
import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.formats import ATTITUDES, QUANTITIES, Names, Units
from quadjax.fitting.identities import (
    AXES,
    MOTORS,
    VECTORS,
    Arrays,
    Change,
    Evidence,
    Signals,
    filter_signals,
)
from quadjax.fitting.magnitudes import scale_hint
from quadjax.fitting.motor_evidence import TYPICAL_LAG_S, MotorEvidence, typical_speeds
from quadjax.fitting.signals import first_order

EVIDENCE = 6.0  # least gain of log-likelihood that is evidence
CHECKED = (*VECTORS, *ATTITUDES, "rpm", "motor_command")
LONGEST_DELAY_S = 0.6  # that is looked for
SCALES = 1.1 ** np.arange(-73.0, 74.0)  # of up to a thousand
ANGLES_DEG = np.arange(-175.0, 181.0, 5.0)
NEGATED = "negated"
UNRELATED = "of something else"
ALONE = 6.0  # log-likelihood: the columns of a sensor are rarely late one by one


def check_consistency(
    path: str,
    names: Names,
    units: Units,
    quantities: Arrays,
    rate: float,
    flying: np.ndarray,
    frames: tuple[str, str],
    config: LogsConfig,
) -> list[str]:
    """Compare the columns of a log with one another.

    Args:
        path: of the log, for messages.
        names: of the columns, by quantity.
        units: of the columns, with their factors, by quantity.
        quantities: (n, k), evenly sampled, in the standard units and frames, but for the angles
            ``euler`` of the log's own frames; the quaternion is scalar last.
        rate: Hz, of the samples.
        flying: (n,) whether in flight.
        frames: body and world of the log, keys of ``FROM_FRD`` and ``TO_NED``.
        config: with the largest allowed errors of scale, time and angle.

    Returns:
        The columns that could not be checked because of missing evidence, as text.

    Raises:
        InputError: columns of which a change explains the log much better, in one line.
    """
    form = next((form for form in ATTITUDES if form in names), "")
    signals = filter_signals(_with_motors(quantities, rate), flying, rate)
    if signals is None:
        return [f"{_listed(names[name])} (a short flight)" for name in CHECKED if name in names]
    commands = names.get("motor_command", [])
    attitude = names[form][form == "quaternion" :] if form else []
    followed = names.get("rpm_command", commands)
    names = {"rpm": commands, "followed": followed, **names, "attitude": attitude}
    rows, gains = _search(signals, names, form, frames, config)
    allowed = np.array([change.allowed for _, change in rows])
    beyond = gains - [change.unlikely for _, change in rows]
    best = int(np.where(allowed, -np.inf, beyond).argmax())
    gain = float(beyond[best] - gains[allowed].max(initial=0.0))
    if gain > EVIDENCE:
        quantity, change = rows[best]
        columns, hint = [names[quantity][i] for i in change.columns], ""
        if change.scale != 1.0:
            hint = scale_hint(QUANTITIES[quantity].unit, change.scale, units[quantity])
        raise InputError(
            f"{path}: column{'s' * (len(columns) > 1)} {_listed(columns)} "
            f"{change.text.format(*names[quantity])}{hint or '?'} That explains the log "
            f"much better: log-likelihood {gain:+.0f}, allowed: {EVIDENCE:+.0f}"
        )
    lines = _unchecked(rows, gains, names)
    if "position" in names and not form:
        lines.append(f"{_listed(names['position'])} (no attitude)")
    return lines


def _listed(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))


def _with_motors(quantities: Arrays, rate: float) -> dict[str, np.ndarray]:
    """The quantities, with typical speeds in place of none, or those that the commands cause."""
    result = dict(quantities)
    if "rpm" not in result:
        result["rpm"] = typical_speeds(result["motor_command"], rate)
    elif "rpm_command" in result:
        command = result["rpm_command"]
        result["followed"] = first_order(command, command[0], TYPICAL_LAG_S, 1.0 / rate)
    elif "motor_command" in result:
        result["followed"] = typical_speeds(result["motor_command"], rate)
    return result


def _search(
    signals: Signals, names: Names, form: str, frames: tuple[str, str], config: LogsConfig
) -> tuple[list[tuple[str, Change]], np.ndarray]:
    """Quantities and all changes of their columns, the simple ones first, and gains (h,)."""
    evidence, motors = Evidence(signals, names, frames), MotorEvidence(signals)
    vectors = vector_changes(config.max_scale_error, config.max_delay, config.max_angle)
    candidates = {name: vectors for name in VECTORS if name in names and evidence.laws_of(name)}
    if form:
        candidates["attitude"] = attitude_changes(form, config.max_delay)
    candidates["rpm"] = motor_changes(config.max_delay, True)
    if "followed" in signals.values:
        candidates["followed"] = motor_changes(config.max_delay + 2.0 * TYPICAL_LAG_S, False)
    rows: list[tuple[str, Change]] = []
    gains: list[np.ndarray] = []
    for quantity, changes in candidates.items():
        rows += [(quantity, change) for change in changes]
        gains.append(evidence.gains(quantity, changes) + motors.gains(quantity, changes))
        if form and quantity in VECTORS:
            rows += [(quantity, change) for change in OTHER_COLUMNS]
            gains.append(evidence.gains_unrelated(quantity))
    return rows, np.concatenate(gains)


def _unchecked(rows: list[tuple[str, Change]], gains: np.ndarray, names: Names) -> list[str]:
    """Columns whose negation, exchange or absence costs little likelihood."""
    lines: list[str] = []
    moved: dict[str, set[int]] = {}
    for (quantity, change), gain in zip(rows, gains, strict=True):
        if gain <= -EVIDENCE:
            continue
        if change.text in (NEGATED, UNRELATED) and len(change.columns) == 1:
            column = repr(names[quantity][change.columns[0]])
            lines += [column] * (column not in lines)
        if change.spin < 0.0:
            lines.append(f"the direction of the propellers against {names['gyro'][2]!r}")
        if change.order != MOTORS:
            moved.setdefault(quantity, set()).update(change.columns)
    for quantity, columns in moved.items():
        lines.append(f"the order of {_listed([names[quantity][i] for i in sorted(columns)])}")
    return lines


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
    sizes = np.arange(0.02, LONGEST_DELAY_S, 0.02)  # s: the speeds change fast
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
        wrong = (
            f"{factor:.3g} times too large"
            if factor > 1.0
            else f"{1.0 / factor:.3g} times too small"
        )
        text, allowed = (
            f"{wrong} (logs.units, logs.max_scale_error)",
            1.0 / largest <= factor <= largest,
        )
        scale = 1.0 / factor if columns == AXES else 1.0
        yield Change(columns, text, allowed, matrix, scale=scale)


def _rotated(largest: float) -> Iterator[Change]:
    """Rotations in each plane of two columns."""
    for columns, angle in itertools.product(itertools.combinations(AXES, 2), ANGLES_DEG):
        matrix, turn = np.eye(3), np.radians(angle)
        rotation = [[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]
        matrix[np.ix_(columns, columns)] = rotation
        text = f"rotated by {angle:g} deg (logs.max_angle)"
        yield Change(columns, text, abs(angle) <= largest, matrix)


def _delays(columns: tuple[int, ...], largest: float) -> Iterator[Change]:
    """Delays of smooth signals, each half as much again as the next shorter one."""
    sizes = largest * np.array([0.5, 1.0, *(1.5 * 1.4 ** np.arange(30.0))])
    return _delayed(columns, sizes[sizes <= max(LONGEST_DELAY_S, largest)], largest)


def _delayed(columns: tuple[int, ...], sizes: np.ndarray, largest: float) -> Iterator[Change]:
    for size, sign in itertools.product(sizes, (1.0, -1.0)):
        text = f"{size:.3g} s {'late' if sign > 0.0 else 'early'} (logs.max_delay)"
        unlikely = ALONE if len(columns) == 1 else 0.0
        delay, allowed = float(sign * size), bool(size <= largest)
        yield Change(columns, text, allowed, delay=delay, unlikely=unlikely)
