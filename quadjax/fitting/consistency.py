"""Consistency of a flight log's columns with one another, by one principle.

Kinematics and Newton's law relate the quantities of a log. A log is refused when one simple change
of the columns of one quantity (negated or permuted axes or motors, a scale, a delay, a rotation, a
column of something else) explains it much better than the columns as logged. The measure is the
gain of the log-likelihood over that of the best change within ``logs.max_scale_error``,
``logs.max_delay`` and ``logs.max_angle``. A column is not checked if its negation or its absence
costs little likelihood, or a motor if its exchange does.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting import changes as simple
from quadjax.fitting.changes import Change
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.formats import ATTITUDES
from quadjax.fitting.identities import VECTORS, Arrays, Signals, evidence_of, signals_of
from quadjax.fitting.motor_evidence import LAG, motor_evidence, typical_speeds
from quadjax.fitting.signals import first_order

EVIDENCE = 6.0  # least gain of log-likelihood that is evidence
CHECKED = (*VECTORS, *ATTITUDES, "rpm", "motor_command")
Names = Mapping[str, list[str]]


def check_consistency(
    path: str,
    names: Names,
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
    signals = signals_of(_with_motors(quantities, rate), flying, rate)
    if signals is None:
        return [f"{_listed(names[name])} (a short flight)" for name in CHECKED if name in names]
    attitude = names[form][form == "quaternion" :] if form else []
    names = {**names, "attitude": attitude}
    rows, gains = _search(signals, names, form, frames, config)
    allowed = np.array([change.allowed for _, change in rows])
    beyond = gains - [change.unlikely for _, change in rows]
    best = int(np.where(allowed, -np.inf, beyond).argmax())
    gain = float(beyond[best] - gains[allowed].max(initial=0.0))
    if gain > EVIDENCE:
        quantity, change = rows[best]
        columns = [names[quantity][i] for i in change.columns]
        raise InputError(
            f"{path}: column{'s' * (len(columns) > 1)} {_listed(columns)} "
            f"{change.text.format(*names[quantity])}? That explains the log much better: "
            f"log-likelihood {gain:+.0f}, allowed: {EVIDENCE:+.0f}"
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
        result["followed"] = first_order(command, command[0], LAG, 1.0 / rate)
    elif "motor_command" in result:
        result["followed"] = typical_speeds(result["motor_command"], rate)
    return result


def _search(
    signals: Signals, names: Names, form: str, frames: tuple[str, str], config: LogsConfig
) -> tuple[list[tuple[str, Change]], np.ndarray]:
    """Quantities and all changes of their columns, the simple ones first, and gains (h,)."""
    evidence, motors = evidence_of(signals, names, frames), motor_evidence(signals)
    rows: list[tuple[str, Change]] = []
    gains: list[np.ndarray] = []

    def add(quantity: str, changes: Sequence[Change], gained: np.ndarray) -> None:
        rows.extend((quantity, change) for change in changes)
        gains.append(gained)

    largest = config.max_delay
    group = simple.vector_changes(config.max_scale_error, largest, config.max_angle)
    used = {name for law in evidence.identities for name in law.linear + law.nonlinear}
    for quantity in (name for name in VECTORS if name in names and name in used):
        gained = evidence.gains(quantity, group)
        add(quantity, group, gained + (motors.gains("gyro", group) if quantity == "gyro" else 0.0))
        if form:
            add(quantity, simple.OTHER_COLUMNS, evidence.gains_unrelated(quantity))
    if form:
        group = simple.attitude_changes(form, largest)
        add("attitude", group, evidence.gains("attitude", group))
    group = simple.motor_changes(largest, True)
    add("rpm" if "rpm" in names else "motor_command", group, motors.gains("speeds", group))
    if "followed" in signals.values:
        group = simple.motor_changes(largest + 2.0 * LAG, False)
        commands = "rpm_command" if "rpm_command" in names else "motor_command"
        add(commands, group, motors.gains("commands", group))
    return rows, np.concatenate(gains)


def _unchecked(rows: list[tuple[str, Change]], gains: np.ndarray, names: Names) -> list[str]:
    """Columns whose negation, exchange or absence costs little likelihood."""
    lines: list[str] = []
    moved: dict[str, set[int]] = {}
    for (quantity, change), gain in zip(rows, gains, strict=True):
        if gain <= -EVIDENCE:
            continue
        if change.text in (simple.NEGATED, simple.UNRELATED) and len(change.columns) == 1:
            column = repr(names[quantity][change.columns[0]])
            lines += [column] * (column not in lines)
        if change.spin < 0.0:
            lines.append(f"the direction of the propellers against {names['gyro'][2]!r}")
        if change.order != simple.MOTORS:
            moved.setdefault(quantity, set()).update(change.columns)
    for quantity, columns in moved.items():
        lines.append(f"the order of {_listed([names[quantity][i] for i in sorted(columns)])}")
    return lines
