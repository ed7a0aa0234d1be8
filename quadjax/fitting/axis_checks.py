"""Checks of a flight log's columns by comparing them with one another.

Kinematics relate the quantities of a log: the derivative of the attitude gives the body rates, that
of the position the velocity, that of the velocity minus gravity the specific force, and the
propeller speeds the angular accelerations. A column that is negated, swapped with another, scaled,
late, rotated or unrelated is inconsistent with the others. Where a flight has too little motion
along or about an axis there is no evidence, and the column is reported as not checked.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.fitting.alignment import delay_of, late, wrong_angle, wrong_factor
from quadjax.fitting.columns import ATTITUDES, UNIT_OF
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.gravity_checks import check_gravity
from quadjax.fitting.signals import derivative, low_pass

if TYPE_CHECKING:
    from quadjax.fitting.flight_log import FlightLog

BAND = 5.0  # Hz, of the motion that is compared
EDGE = 0.3  # s, left out at either end of a log, where the filters distort the signals
SHORTEST = 1.0  # s, least duration without the ends
GRAVITY = np.array([0.0, 0.0, 9.81])  # m/s^2, world
EXPLAINED = 0.5  # least fraction of a column's variance that a matching signal explains
UNRELATED = 0.3  # correlation with its own signal below which a column is unrelated


@dataclass(frozen=True)
class Evidence:
    """Columns of one quantity, and the same signals computed from other columns: (n, k) each."""

    quantity: str
    columns: list[str]
    measured: np.ndarray
    shown: np.ndarray
    meanings: list[str]  # names of the columns of ``shown``
    source: str  # the columns that ``shown`` is computed from
    least: float | np.ndarray  # standard deviation of ``shown`` that is motion and not noise
    slack: float = 0.0  # s, that the columns may be late for another reason
    vectors: bool = True  # three columns along perpendicular axes
    scaled: bool = True  # whether a change of the columns is as large as that of the signals


@dataclass(frozen=True)
class Verdict:
    """Columns that contradict the evidence, one clause each, and columns without evidence."""

    contradictions: list[str]
    unchecked: list[str]


def check_axes(log: "FlightLog", config: LogsConfig) -> list[str]:
    """Compare gyro, velocity and accelerometer of a log with its other columns.

    Args:
        log: the columns.
        config: with the largest allowed errors of scale, time and angle.

    Returns:
        The columns that could not be checked because of missing evidence, as text.

    Raises:
        InputError: a column that contradicts the others, in one line.
    """
    if log.attitude is None:
        return check_gravity(log, config)
    unchecked: list[str] = []
    for evidence_of in (_gyro, _velocity, _acceleration):
        found = evidence_of(log, log.attitude)
        unchecked += [found] if isinstance(found, str) else compare(log, found, config)
    return unchecked


def compare(log: "FlightLog", candidates: list[Evidence], config: LogsConfig) -> list[str]:
    """Check the columns of one quantity, by evidence in one frame or in several.

    Results and errors as of ``check_axes``.
    """
    rows = inner_rows(log)
    if not len(rows):
        return [repr(name) for evidence in candidates for name in evidence.columns]
    moving = [_moving(log, evidence, rows) for evidence in candidates]
    rate = log.sample_rate
    verdicts = [_verdict(evidence, rate, config) for evidence in moving]
    # A wrong column in one frame makes several columns appear wrong in the other.
    contradictions = sorted((v.contradictions for v in verdicts if v.contradictions), key=len)
    contradictions += [clauses for each in moving if (clauses := _misaligned(each, config))]
    if contradictions:
        raise InputError(f"{log.path}: {', '.join(contradictions[0])}")
    return [line for verdict in verdicts for line in verdict.unchecked]


def listed(names: list[str]) -> str:
    """Names of columns in quotes, for a message."""
    return ", ".join(repr(name) for name in names)


def inner_rows(log: "FlightLog") -> np.ndarray:
    """Indices of the rows in flight, without the ends of the log; empty for a short flight."""
    edge = round(EDGE * log.sample_rate)
    rows = np.flatnonzero(log.flying[edge:-edge]) + edge
    return rows if len(rows) > SHORTEST * log.sample_rate else rows[:0]


def _gyro(log: "FlightLog", attitude: Rotation) -> list[Evidence]:
    names = log.columns["gyro"]
    span = max(1, round(0.02 * log.sample_rate))

    def padded(values: np.ndarray) -> np.ndarray:
        """Differences over two spans as rates (n, 3), rad/s."""
        rates = np.pad(values, ((span, span), (0, 0)), "edge")
        return rates * (0.5 * log.sample_rate / span)

    turn = padded((attitude[: -2 * span].inv() * attitude[2 * span :]).as_rotvec())
    meanings = ["roll rate", "pitch rate", "yaw rate"]
    result = [Evidence("gyro", names, log.rates, turn, meanings, _attitude(log), 0.05)]
    if "euler" not in log.columns:
        return result
    # The derivatives of the angles, times the cosine of pitch, where they are not singular.
    roll, pitch, _ = angles = attitude.as_euler("ZYX").T[::-1]
    change = angles[:, 2 * span :] - angles[:, : -2 * span]
    slopes = padded(((change + np.pi) % (2.0 * np.pi) - np.pi).T) * np.cos(pitch)[:, None]
    p, q, r = log.rates.T
    yawing = q * np.sin(roll) + r * np.cos(roll)
    pitching = q * np.cos(roll) - r * np.sin(roll)
    rolling = p * np.cos(pitch) + yawing * np.sin(pitch)
    shown = np.stack([rolling, pitching * np.cos(pitch), yawing], axis=1)
    meanings = [f"derivative of {angle}" for angle in ("roll", "pitch", "yaw")]
    own = log.columns["euler"]
    euler = Evidence("euler", own, slopes, shown, meanings, listed(names), 0.05, vectors=False)
    return [*result, euler]


def _velocity(log: "FlightLog", attitude: Rotation) -> list[Evidence] | str:
    quantity = "world_velocity" if "world_velocity" in log.columns else "body_velocity"
    names = log.columns[quantity]
    if log.position is None:
        return f"{listed(names)} (no position)"
    moved, speed = derivative(log.position, log.sample_rate), attitude.apply(log.body_velocity)
    of_position = listed(log.columns["position"])
    world = [f"velocity {direction}" for direction in ("north", "east", "down")]
    if quantity == "world_velocity":
        return [Evidence(quantity, names, speed, moved, world, of_position, 0.1)]
    own = [f"velocity along body {axis}" for axis in "xyz"]
    seen = attitude.inv().apply(moved)
    return [
        Evidence(quantity, names, log.body_velocity, seen, own, of_position, 0.1),
        Evidence("position", log.columns["position"], moved, speed, world, listed(names), 0.1),
    ]


def _acceleration(log: "FlightLog", attitude: Rotation) -> list[Evidence]:
    names, force = log.columns["acceleration"], log.specific_force
    velocity = listed(log.columns.get("body_velocity") or log.columns["world_velocity"])
    meanings = [f"specific force along body {axis}" for axis in "xyz"]
    slope = derivative(attitude.apply(log.body_velocity), log.sample_rate)
    shown, source = attitude.inv().apply(slope - GRAVITY), f"{velocity}, {_attitude(log)}"
    return [Evidence("acceleration", names, force, shown, meanings, source, 0.3)]


def _attitude(log: "FlightLog") -> str:
    return listed(next(log.columns[name] for name in ATTITUDES if name in log.columns))


def _moving(log: "FlightLog", evidence: Evidence, rows: np.ndarray) -> Evidence:
    """Some rows of the evidence, low-pass filtered, about its mean; noise raises ``least``."""

    def passed(values: np.ndarray, band: float = BAND) -> np.ndarray:
        smooth = low_pass(values, log.sample_rate, band)[rows]
        return smooth - smooth.mean(axis=0)

    shown = passed(evidence.shown)
    above = passed(evidence.shown, min(2.0 * BAND, 0.45 * log.sample_rate)) - shown
    return replace(
        evidence,
        measured=passed(evidence.measured),
        shown=shown,
        least=np.maximum(evidence.least, 2.0 * above.std(axis=0)),
    )


def _verdict(evidence: Evidence, rate: float, config: LogsConfig) -> Verdict:
    """Match each column to its own signal, late or not, to another's, or the negative of one."""
    own, theirs = evidence.measured.std(axis=0), np.maximum(evidence.shown.std(axis=0), 1e-12)
    ratio = own[:, None] / theirs
    product = evidence.measured.T @ evidence.shown / len(evidence.shown)
    correlation = product / np.maximum(own[:, None] * theirs, 1e-24)
    moves = theirs > evidence.least
    clauses, unchecked, hints = [], [], {}
    for i, name in enumerate(evidence.columns):
        signed = np.stack([correlation[i], -correlation[i]])
        unexplained = 1.0 - np.maximum(signed, 0.0) ** 2
        right = unexplained[0, i]
        unexplained[:, (ratio[i] < 0.5) | (ratio[i] > 2.0)] = 1.0
        sign, axis = divmod(int(unexplained.argmin()), unexplained.shape[1])
        least = unexplained[sign, axis]
        delay = delay_of(evidence.measured[:, i], evidence.shown[:, i], rate)
        if delay.unexplained < least and late(delay, right, evidence.slack, config):
            word = "later" if delay.seconds > 0.0 else "earlier"
            clauses.append(
                f"column {name!r} is {abs(delay.seconds):.3g} s {word} than the "
                f"{evidence.meanings[i]}"
            )
            hints["allowed: logs.max_delay"] = None
        elif (sign, axis) != (0, i) and least < EXPLAINED and least < 0.25 * right:
            clauses.append(f"column {name!r} is {'minus ' * sign}the {evidence.meanings[axis]}")
            hints["swapped?" if axis != i else "negated?"] = None
        elif right < EXPLAINED and not 0.2 < ratio[i, i] < 5.0:
            clauses.append(f"column {name!r} is {ratio[i, i]:.3g} times the {evidence.meanings[i]}")
            hints[f"is logs.{_scale_key(evidence.quantity)} right?"] = None
        elif right >= EXPLAINED and correlation[i, i] < UNRELATED and moves[i]:
            clauses.append(f"column {name!r} does not follow the {evidence.meanings[i]}")
        elif right >= EXPLAINED:
            unchecked.append(repr(name))
    if clauses:
        clauses[-1] += f" from {evidence.source}"
        clauses[-1] += f" (correlation {correlation.diagonal().min():.2f}); {' '.join(hints)}"
    return Verdict([clause.rstrip("; ") for clause in clauses], unchecked)


def _scale_key(quantity: str) -> str:
    """The key of the section ``logs`` that scales a quantity."""
    return f"units.{UNIT_OF[quantity]}" if quantity in UNIT_OF else "motor_range"


def _misaligned(evidence: Evidence, config: LogsConfig) -> list[str]:
    """Columns that are rotated or scaled by more than allowed."""
    measured, shown = evidence.measured, evidence.shown
    if evidence.vectors and (turned := wrong_angle(measured, shown, config)):
        i, k, angle = turned
        return [
            f"columns {listed([evidence.columns[i], evidence.columns[k]])} are rotated by "
            f"{angle:.0f} deg from the {evidence.meanings[i]} and {evidence.meanings[k]} from "
            f"{evidence.source}; allowed: {config.max_angle:g} deg (logs.max_angle)"
        ]
    moves = shown.std(axis=0) > evidence.least
    factors = {
        i: factor
        for i in range(len(evidence.columns))
        if evidence.scaled
        and moves[i]
        and (factor := wrong_factor(measured[:, i], shown[:, i], config))
    }
    clauses = [
        f"column {evidence.columns[i]!r} is {factor:.3g} times the {evidence.meanings[i]}"
        for i, factor in factors.items()
    ]
    if clauses:
        clauses[-1] += f" from {evidence.source} (logs.units, logs.max_scale_error)"
    return clauses
