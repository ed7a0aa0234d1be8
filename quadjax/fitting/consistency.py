"""Consistency of a flight log's columns with one another, by one principle.

Kinematics and Newton's law relate the quantities of a log. A log is refused when one simple change
of the columns of one quantity (negated or permuted axes or motors, a scale, a delay, a rotation, a
column of something else) explains it much better than the columns as logged. The measure is the
gain of the log-likelihood over that of the best change within ``logs.max_scale_error``,
``logs.max_delay`` and ``logs.max_angle``. A column is not checked if its negation or its absence
costs little likelihood, or a motor if its exchange does.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting import identities as laws
from quadjax.fitting.changes import (
    NEGATED,
    UNRELATED,
    Change,
    Limits,
    attitude_changes,
    motor_changes,
    other_propellers,
    unrelated,
    vector_changes,
)
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.formats import ATTITUDES, FROM_FRD, TO_NED
from quadjax.fitting.identities import Arrays, Identity, Signals, signals_of
from quadjax.fitting.motor_evidence import LAG, motor_evidence, typical_speeds
from quadjax.fitting.signals import first_order

EVIDENCE = 6.0  # least gain of log-likelihood that is evidence
VECTORS = ("gyro", "acceleration", "body_velocity", "world_velocity", "position")
CHECKED = (*VECTORS, *ATTITUDES, "rpm", "motor_command")
Names = Mapping[str, list[str]]


@dataclass(frozen=True)
class Evidence:
    """A log's signals and the identities that they have to fulfill."""

    signals: Signals
    quantities: Arrays  # (m, 3) as logged, the attitude (m, 3, 3)
    identities: tuple[Identity, ...]
    frames: tuple[str, str]  # of the log: body and world

    def gains(self, changes: Sequence[Change]) -> np.ndarray:
        """Gains (h,) of log-likelihood by changes of one vector quantity or of the attitude."""
        quantity, gains = changes[0].quantity, np.zeros(len(changes))
        matrices = np.stack([change.matrix for change in changes])
        late = np.array([change.delay != 0.0 for change in changes])
        for identity in self.identities:
            if quantity in identity.nonlinear:
                gains += self._each(identity, changes)
            elif quantity in identity.uses:
                gains[~late] += self._linear(identity, quantity, matrices[~late])
                gains[late] += self._each(identity, [c for c in changes if c.delay != 0.0])
        return gains

    def gains_unrelated(self, quantity: str) -> np.ndarray:
        """Gains (3,) of log-likelihood if a column of a vector contains something else.

        Then the residual is larger than each of its two independent parts, that of the column and
        that of all other columns. Otherwise it is smaller than one of them, unless both are noise.
        """
        signals, gains = self.signals, np.zeros(3)
        for identity in self.identities:
            if quantity not in identity.uses or quantity in identity.nonlinear:
                continue
            values = self.quantities[quantity]
            stack = np.stack([values] + [values * (np.arange(3) != i) for i in range(3)])
            parts = identity.residual({**self.quantities, quantity: stack}, signals.rate)
            whole, *others = signals.low_pass(parts)[:, signals.inner]
            for i, rest in enumerate(others):
                sizes = [x.var(axis=0) + identity.noise**2 for x in (whole, rest, whole - rest)]
                ratio = sizes[0] / np.maximum(sizes[1], sizes[2])
                gains[i] += 0.5 * signals.count(identity.band) * np.log(ratio).sum()
        return gains

    def corrected(self, changes: Sequence[Change]) -> np.ndarray:
        """A quantity after each change, (h, m, 3), or (h, m, 3, 3) of the attitude."""
        signals, quantity = self.signals, changes[0].quantity
        matrices = np.stack([change.matrix for change in changes])
        if quantity != "attitude":
            values = np.stack([signals.at(quantity)] * len(changes))
            for row, change in zip(values, changes, strict=True):
                if change.delay:
                    columns = list(change.columns)
                    row[:, columns] = signals.at(quantity, change.delay)[:, columns]
            return values @ matrices.swapaxes(1, 2)
        form = "euler" if "euler" in signals.values else "quaternion"
        values = np.stack([signals.at(form, change.delay) for change in changes])
        values[..., :3] = values[..., :3] @ matrices.swapaxes(1, 2)
        if form == "quaternion":
            return laws.matrices_of_quaternions(values)
        rotations = laws.matrices_of_quaternions(laws.quaternions_of_angles(values))
        body, world = self.frames
        return TO_NED[world].as_matrix() @ rotations @ FROM_FRD[body].as_matrix()

    def _each(self, identity: Identity, changes: Sequence[Change]) -> np.ndarray:
        """Gains (h,) by evaluating the identity under every change."""
        quantity, signals = changes[0].quantity, self.signals
        stack = np.concatenate([self.quantities[quantity][None], self.corrected(changes)])
        residual = identity.residual({**self.quantities, quantity: stack}, signals.rate)
        residual = signals.low_pass(residual)[:, signals.inner]
        mean, square = residual.mean(axis=1), (residual**2).mean(axis=1)
        likelihood = laws.log_likelihood(identity, mean, square, signals.count(identity.band))
        shrinking = self._shrinking(identity, np.stack([change.matrix for change in changes]))
        return likelihood[1:] - likelihood[0] - shrinking

    def _linear(self, identity: Identity, quantity: str, matrices: np.ndarray) -> np.ndarray:
        """Gains (h,) by matrices (h, 3, 3) on a quantity on which the identity depends linearly.

        The residual is one without the quantity, plus one for each element of the matrix.
        """
        values, signals = self.quantities[quantity], self.signals
        stack = np.zeros((10, *values.shape))
        for i, k in itertools.product(range(3), range(3)):
            stack[1 + 3 * i + k, :, i] = values[:, k]
        parts = identity.residual({**self.quantities, quantity: stack}, signals.rate)
        parts = signals.low_pass(parts)[:, signals.inner]
        parts[1:] -= parts[0]
        gram = np.einsum("hni,gni->ihg", parts, parts, optimize=True) / parts.shape[1]
        elements = np.concatenate([np.eye(3)[None], matrices]).reshape(-1, 9)
        elements = np.pad(elements, ((0, 0), (1, 0)), constant_values=1.0)
        mean = np.einsum("eh,hi->ei", elements, parts.mean(axis=1))
        square = ((elements @ gram) * elements).sum(axis=2).T
        likelihood = laws.log_likelihood(identity, mean, square, signals.count(identity.band))
        return likelihood[1:] - likelihood[0] - self._shrinking(identity, matrices)

    def _shrinking(self, identity: Identity, matrices: np.ndarray) -> np.ndarray:
        """Likelihood (h,) that a residual gains merely because a correction makes it smaller."""
        factors = np.linalg.norm(matrices, axis=2)
        count = self.signals.count(identity.band)
        return count * np.maximum(-np.log(factors), 0.0).sum(axis=1)


def evidence_of(signals: Signals, names: Names, frames: tuple[str, str]) -> Evidence:
    """The identities that the quantities of a log have to fulfill."""
    quantities = {name: signals.at(name) for name in VECTORS if name in signals.values}
    if "quaternion" not in signals.values:
        measured = laws.gravity(quantities, signals.rate)
        down = measured - laws.turning_gravity(quantities, signals.rate)
        quantities["down"] = down / np.maximum(np.linalg.norm(down, axis=1, keepdims=True), 1e-9)
        laws_of_log = (laws.TURNING_GRAVITY, laws.GRAVITY_SIZE)
        return Evidence(signals, quantities, laws_of_log, frames)
    quantities["attitude"] = laws.matrices_of_quaternions(signals.at("quaternion"))
    world = "world_velocity" in names
    chosen = [laws.TURNING, laws.FORCING if world else laws.FORCING_BODY]
    if "position" in quantities:
        chosen.append(laws.MOVING if world else laws.MOVING_BODY)
    return Evidence(signals, quantities, tuple(chosen), frames)


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
    names = dict(names)
    form = next((form for form in ATTITUDES if form in names), "")
    if form:
        names["attitude"] = names[form][1:] if form == "quaternion" else names[form]
    signals = signals_of(_with_motors(quantities, rate), flying, rate)
    if signals is None:
        return [f"{listed(names[name])} (a short flight)" for name in CHECKED if name in names]
    changes, gains = _search(signals, names, form, frames, config)
    allowed = np.array([change.allowed for change in changes])
    best_allowed = max(0.0, float(gains[allowed].max(initial=0.0)))
    unlikely = np.array([change.unlikely for change in changes])
    gains_beyond = np.where(allowed, -np.inf, gains - unlikely)
    best = int(gains_beyond.argmax())
    gain = float(gains_beyond[best]) - best_allowed
    if gain > EVIDENCE:
        change = changes[best]
        columns = [names[change.quantity][i] for i in change.columns]
        raise InputError(
            f"{path}: column{'s' * (len(columns) > 1)} {listed(columns)} {change.text}? That "
            f"explains the log much better: log-likelihood {gain:+.0f}, "
            f"allowed: {EVIDENCE:+.0f}"
        )
    lines = _unchecked(changes, gains, names)
    if "position" in names and not form:
        lines.append(f"{listed(names['position'])} (no attitude)")
    return lines


def listed(names: list[str]) -> str:
    """Names of columns in quotes, for a message."""
    return ", ".join(repr(name) for name in names)


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
) -> tuple[list[Change], np.ndarray]:
    """Every change of a log's columns, the simple ones first, and its gain of log-likelihood."""
    evidence, motors = evidence_of(signals, names, frames), motor_evidence(signals)
    limits = Limits(config.max_scale_error, config.max_delay, config.max_angle)
    used = {name for law in evidence.identities for name in law.uses}
    changes: list[Change] = []
    gains: list[np.ndarray] = []
    for quantity in VECTORS:
        if quantity in names and quantity in used:
            changes += (group := vector_changes(quantity, tuple(names[quantity]), limits))
            gains.append(evidence.gains(group))
            if quantity == "gyro":
                gains[-1] += motors.gains_of_gyro(group)
            if form:
                changes += unrelated(quantity)
                gains.append(evidence.gains_unrelated(quantity))
    if form:
        changes += (group := attitude_changes(form, tuple(names["attitude"]), limits))
        gains.append(evidence.gains(group))
    speeds = "rpm" if "rpm" in names else "motor_command"
    group = (other_propellers(speeds), *motor_changes(speeds, tuple(names[speeds]), limits))
    changes += group
    gains.append(motors.gains_of_speeds(group))
    if "followed" in signals.values:
        commands = "rpm_command" if "rpm_command" in names else "motor_command"
        changes += (group := motor_changes(commands, tuple(names[commands]), limits, 2.0 * LAG))
        gains.append(motors.gains_of_commands(group))
    return changes, np.concatenate(gains)


def _unchecked(changes: list[Change], gains: np.ndarray, names: Names) -> list[str]:
    """Columns whose negation, exchange or absence costs little likelihood."""
    lines: list[str] = []
    moved: dict[str, set[int]] = {}
    for change, gain in zip(changes, gains, strict=True):
        if gain <= -EVIDENCE:
            continue
        if change.text in (NEGATED, UNRELATED) and len(change.columns) == 1:
            column = repr(names[change.quantity][change.columns[0]])
            lines += [column] * (column not in lines)
        if change.spin < 0.0:
            lines.append(f"the direction of the propellers against {names['gyro'][2]!r}")
        if change.order != (0, 1, 2, 3):
            moved.setdefault(change.quantity, set()).update(change.columns)
    for quantity, columns in moved.items():
        lines.append(f"the order of {listed([names[quantity][i] for i in sorted(columns)])}")
    return lines
