"""Checks of a flight log without an attitude: gravity must rotate as the gyro measures.

The derivative of the body velocity, plus its cross product with the rates, minus the specific
force, is gravity in body axes. It has one magnitude, and the rates rotate it. Hypotheses (a
column negated, two swapped, one quantity scaled, late or rotated) are tried; where one of them
makes gravity far more consistent than the columns as logged, the log is rejected.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.signals import derivative, low_pass

if TYPE_CHECKING:
    from quadjax.fitting.flight_log import FlightLog

GRAVITY = 9.81  # m/s^2
BAND = 5.0  # Hz, of the motion
RATE = 50.0  # Hz, of the samples compared
SECONDS = 120.0  # longest part of a log that is compared
EDGE = 0.5  # s, left out at either end
SETTLING = 1.0  # s, time constant with which the measured direction of gravity is followed
BETTER = 0.8  # ratio of the errors below which a hypothesis is evident
UNSURE = 1.25  # ratio of the errors below which a negated column is not evident
ANGLES = (-90.0, -45.0, 45.0, 90.0)  # deg
NEGATED = "negated"
POWERS = (-3.0, -2.0, -1.5, -1.0, 1.0, 1.5, 2.0, 3.0)  # of the allowed scale error
QUANTITIES = ("gyro", "acceleration", "body_velocity")


@dataclass(frozen=True)
class Hypothesis:
    """What may be wrong with columns of one quantity, and the change that corrects it."""

    quantity: str
    columns: tuple[int, ...]
    text: str  # after the names of the columns
    matrix: np.ndarray  # (3, 3)
    shift: float = 0.0  # s, by which the columns are late

    @property
    def negates(self) -> bool:
        """Whether one column is negated."""
        return self.text == NEGATED


def check_gravity(log: "FlightLog", config: LogsConfig) -> list[str]:
    """Compare gyro, accelerometer and body velocity with one another.

    Args:
        log: without an attitude.
        config: with the largest allowed errors of scale and time.

    Returns:
        The columns that could not be checked because of missing evidence, as text.

    Raises:
        InputError: columns that make gravity inconsistent, in one line.
    """
    names = log.columns | {
        "body_velocity": log.columns.get("body_velocity") or log.columns["world_velocity"]
    }
    hypotheses = [Hypothesis("gyro", (), "", np.eye(3)), *_hypotheses(config)]
    errors = _errors(log, hypotheses)
    if errors is None:
        return [repr(name) for quantity in QUANTITIES for name in names[quantity]]
    best = int(errors.argmin())
    if errors[best] < BETTER * errors[0]:
        wrong = hypotheses[best]
        columns = [names[wrong.quantity][i] for i in wrong.columns]
        others = [name for q in QUANTITIES if q != wrong.quantity for name in names[q]]
        raise InputError(
            f"{log.path}: column{'s' * (len(columns) > 1)} {_listed(columns)} {wrong.text}? "
            f"Gravity from these and {_listed(others)} is wrong by {errors[0]:.2g} m/s^2, and by "
            f"{errors[best]:.2g} if so"
        )
    return [
        f"{names[hypothesis.quantity][hypothesis.columns[0]]!r} (no attitude)"
        for hypothesis, error in zip(hypotheses[1:], errors[1:], strict=True)
        if hypothesis.negates and error < UNSURE * errors[0]
    ]


def _listed(names: list[str]) -> str:
    return ", ".join(repr(name) for name in names)


def _hypotheses(config: LogsConfig) -> Iterator[Hypothesis]:
    step, delay = 1.0 + config.max_scale_error, 2.0 * config.max_delay
    for quantity in QUANTITIES:
        for i in range(3):
            yield Hypothesis(quantity, (i,), NEGATED, np.diag(np.where(np.arange(3) == i, -1, 1)))
        for i, k in itertools.combinations(range(3), 2):
            order = np.arange(3)
            order[[i, k]] = k, i
            yield Hypothesis(quantity, (i, k), "swapped", np.eye(3)[order])
            for angle in (angle for angle in ANGLES if abs(angle) > config.max_angle):
                axis = np.cross(np.eye(3)[i], np.eye(3)[k])
                back = Rotation.from_rotvec(-np.radians(angle) * axis).as_matrix()
                yield Hypothesis(quantity, (i, k), f"rotated by {angle:g} deg", back)
        for columns, powers in (
            ((0, 1, 2), POWERS),
            *(((i,), (-3.0, -2.0, 2.0, 3.0)) for i in range(3)),
        ):
            for power in powers:
                text = f"scaled by {step**power:.3g} (logs.units)"
                scale = np.where(np.isin(np.arange(3), columns), step**-power, 1.0)
                yield Hypothesis(quantity, columns, text, np.diag(scale))
        for shift in delay * np.array([-5, -4, -3, -2, -1, 1, 2, 3, 4, 5]):
            text = f"{abs(shift):.3g} s too {'late' if shift > 0 else 'early'}"
            yield Hypothesis(quantity, (0, 1, 2), text, np.eye(3), float(shift))


def _errors(log: "FlightLog", hypotheses: list[Hypothesis]) -> np.ndarray | None:
    """Mean error (hypotheses,) of gravity, m/s^2; None for a log that is too short."""
    start = log.time[int(log.flying.argmax())]
    time = np.arange(start, min(log.time[-1], start + SECONDS), 1.0 / RATE)
    edge = round(EDGE * RATE)
    if len(time) < 4 * edge:
        return None
    rate = log.sample_rate
    band = min(BAND, 0.4 * rate)
    velocity = low_pass(log.body_velocity, rate, band)
    signals = {
        "gyro": low_pass(log.rates, rate, band),
        "acceleration": low_pass(log.specific_force, rate, band),
        "body_velocity": velocity,
        "derivative": derivative(velocity, rate),
    }
    kind = {"derivative": "body_velocity"}

    def under(hypothesis: Hypothesis, name: str) -> np.ndarray:
        own = hypothesis.quantity == kind.get(name, name)
        shifted = time + (hypothesis.shift if own else 0.0)
        values = np.stack([np.interp(shifted, log.time, x) for x in signals[name].T], axis=1)
        return values @ hypothesis.matrix.T if own else values

    def every(name: str) -> np.ndarray:
        return np.stack([under(hypothesis, name) for hypothesis in hypotheses], axis=1)

    rates = every("gyro")
    gravity = every("derivative") + np.cross(rates, every("body_velocity")) - every("acceleration")
    return _inconsistency(gravity, rates)[edge:-edge].mean(axis=0) ** 0.5


def _inconsistency(gravity: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Squared distances (n, k) of gravity (n, k, 3) from its rotation by the rates."""
    squares = np.empty(gravity.shape[:2])
    turned = gravity[: round(RATE)].mean(axis=0)
    for i, (measured, rate) in enumerate(zip(gravity, rates, strict=True)):
        turned = turned - np.cross(rate, turned) / RATE
        turned *= GRAVITY / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-9)
        squares[i] = ((measured - turned) ** 2).sum(axis=1)
        turned = turned + (measured - turned) / (SETTLING * RATE)
    return squares
