"""Order, delay and scale of a flight log's motors, from the angular accelerations they cause.

Each order of the four motors, with each sign of the gyro's axes, predicts the angular
accelerations by the nominal model, with non-negative constants. The likelihoods of these
hypotheses, relative to that of the log as it is, are the evidence. Low frequencies are
left out, because there the propellers' moments balance others that the model lacks.
"""

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import nnls
from scipy.signal import butter, sosfiltfilt

from quadjax.core.errors import InputError
from quadjax.fitting.alignment import correlations
from quadjax.fitting.axis_checks import Evidence, compare, inner_rows, listed
from quadjax.fitting.config import LogsConfig
from quadjax.fitting.nominal import ModelInputs, nominal
from quadjax.fitting.signals import derivative, first_order
from quadjax.vehicle.constants import constant_names
from quadjax.vehicle.motor import MotorConstants

if TYPE_CHECKING:
    from quadjax.fitting.flight_log import FlightLog

BAND = (1.0, 16.0)  # Hz
LAG = 0.05  # s, typical of propellers that follow their commands
TYPICAL = (2500.0, 35_000.0)  # rpm, of a racing drone's motors at commands 0 and 1
EVIDENCE = 6.0  # least difference of log-likelihoods that is evidence
# Signs (3, 4) of roll, pitch and yaw of motors 1 to 4, by the nominal model.
ONE = MotorConstants(**dict.fromkeys(constant_names(MotorConstants), 1.0))
SIGNS = nominal(ONE, ModelInputs(np.eye(4), *(np.zeros((4, k)) for k in (4, 3, 3))))[:, 3:].T
CORNERS = ("front left", "front right", "rear right", "rear left")
ORDERS = tuple(itertools.permutations(range(4)))
FLIPS = tuple(itertools.product((1.0, -1.0), repeat=3))


def typical_speeds(command: np.ndarray, sample_rate: float) -> np.ndarray:
    """Speeds (n, 4), rpm, of typical motors under commands (n, 4) from 0 to 1, sampled at Hz.

    They have the order, the direction and about the delay of the true ones, but not their scale.
    """
    steady = TYPICAL[0] + (TYPICAL[1] - TYPICAL[0]) * np.sqrt(np.clip(command, 0.0, 1.0))
    return first_order(steady, steady[0], LAG, 1.0 / sample_rate)


def check_motors(log: "FlightLog", config: LogsConfig) -> list[str]:
    """Compare the motors' speeds with the angular accelerations.

    Returns:
        The columns that could not be checked because of missing evidence, as text.

    Raises:
        InputError: another order of the motors, another sign of a rate or a delay fits better, or
            one motor's speed is far from that of the others.
    """
    if not len(inner_rows(log)):
        return [f"the order of {listed(log.columns['rpm'])}"]
    _check_each_speed(log, config)
    motion = _motion(log)
    likelihood = _likelihoods(motion)  # (orders, axes, 2 signs)
    total = {
        (order, flips): sum(by_axis[axis, int(sign < 0.0)] for axis, sign in enumerate(flips))
        for order, by_axis in zip(ORDERS, likelihood, strict=True)
        for flips in FLIPS
    }
    # Some hypotheses are equivalent, such as mirrored motors and negated p and r. The signs of a
    # gyro that was compared with the attitude are more certain than the order of the motors.
    doubt = 1 if log.attitude is None else 3
    changes = {
        (order, flips): np.count_nonzero(np.subtract(order, ORDERS[0])) + doubt * flips.count(-1.0)
        for order, flips in total
    }
    best = max(total, key=lambda key: (round(total[key], 3), -changes[key]))
    logged = total[ORDERS[0], FLIPS[0]]
    _check_delay(log, motion, total[best] - logged, config)
    if total[best] > logged + EVIDENCE:
        raise InputError(f"{log.path}: {_contradiction(log, *best)}")
    unsure = [
        name
        for i, name in enumerate(log.columns["rpm"])
        if logged < EVIDENCE + max(total[order, FLIPS[0]] for order in ORDERS if order[i] != i)
    ]
    turns = [
        name
        for axis, name in enumerate(log.columns["gyro"])
        if likelihood[0][axis, 0] < EVIDENCE + likelihood[0][axis, 1]
    ]
    lines = [f"the order of {listed(unsure)}"] if unsure else []
    return lines + [f"{name!r} against the motors" for name in turns]


def check_commands(log: "FlightLog", config: LogsConfig) -> list[str]:
    """Compare the commanded speeds with the measured ones; as ``check_motors``."""
    if log.rpm_command is not None:
        followed = first_order(log.rpm_command, log.rpm[0], LAG, 1.0 / log.sample_rate)
    elif log.motor_command is not None and log.speeds_measured:
        followed = typical_speeds(log.motor_command, log.sample_rate)
    else:
        return []
    own, theirs = (values - values.mean(axis=1, keepdims=True) for values in (followed, log.rpm))
    quantity = "motor_command" if log.rpm_command is None else "rpm_command"
    names, speeds = log.columns[quantity], log.columns["rpm"]
    meanings = [f"speed {name!r}" for name in speeds]
    evidence = Evidence(
        quantity,
        names,
        own,
        theirs,
        meanings,
        listed(speeds),
        least=100.0,
        slack=2.0 * LAG,
        vectors=False,
        scaled=False,
    )
    unchecked = compare(log, [evidence], config)
    _check_levels(log, config)
    return unchecked


def _check_levels(log: "FlightLog", config: LogsConfig) -> None:
    """Commands and speeds have the same level; motors at their limit do not follow every change."""
    rows = inner_rows(log)
    if log.rpm_command is None or not len(rows):
        return
    levels = np.median(log.rpm_command[rows], axis=0) / np.median(log.rpm[rows], axis=0)
    factor, most = float(np.median(levels)), 1.0 + config.max_scale_error
    if not 1.0 / most <= factor <= most:
        raise InputError(
            f"{log.path}: columns {listed(log.columns['rpm_command'])} are {factor:.3g} times the "
            f"speeds {listed(log.columns['rpm'])} (logs.units.rpm, logs.max_scale_error)"
        )


def _check_each_speed(log: "FlightLog", config: LogsConfig) -> None:
    """The motors of a flying quadcopter turn at about the same speed."""
    medians = np.median(log.rpm[inner_rows(log)], axis=0)
    for i, name in enumerate(log.columns["rpm"]):
        factor = medians[i] / np.delete(medians, i).mean()
        most = 1.0 + config.max_scale_error
        if not 1.0 / most <= factor <= most:
            raise InputError(
                f"{log.path}: column {name!r} is {factor:.3g} times the other motors' speeds "
                f"(median {medians[i]:.4g} rpm); allowed: logs.max_scale_error"
            )


def _check_delay(log: "FlightLog", motion: "Motion", rival: float, config: LogsConfig) -> None:
    """Refuse speeds that are late, if that is more likely than another order of the motors."""
    likelihood: np.ndarray | float = 0.0
    for axis in (0, 1):
        delays, correlation = correlations(
            motion.whole_squares @ SIGNS[axis], motion.whole_turning[:, axis], log.sample_rate
        )
        explained = np.minimum(np.maximum(correlation, 0.0) ** 2, 1.0 - 1e-9)
        likelihood = likelihood - 0.5 * motion.independent * np.log1p(-explained)
    best = int(np.argmax(likelihood))
    gain = likelihood[best] - likelihood[len(delays) // 2]
    if abs(delays[best]) > config.max_delay and gain > max(rival, 0.0) + EVIDENCE:
        word = "later" if delays[best] > 0.0 else "earlier"
        raise InputError(
            f"{log.path}: columns {listed(log.columns['rpm'])} are {abs(delays[best]):.3g} s "
            f"{word} than the angular accelerations from {listed(log.columns['gyro'])}; allowed: "
            f"{config.max_delay:g} s (logs.max_delay)"
        )


def _contradiction(log: "FlightLog", order: tuple[int, ...], flips: tuple[float, ...]) -> str:
    """The columns of a log that differ from another hypothesis, as text."""
    names, rates, parts = log.columns["rpm"], log.columns["gyro"], []
    if order != ORDERS[0]:
        moved = [names[i] for i in range(4) if order[i] != i]
        fits = ", ".join(f"{names[i]!r} {corner}" for i, corner in zip(order, CORNERS, strict=True))
        parts.append(
            f"columns {listed(moved)} swapped? by the angular accelerations they are {fits}"
        )
    for name, sign in zip(rates, flips, strict=True):
        if sign < 0.0:
            parts.append(
                f"column {name!r} has the opposite sign of the moments of {listed(names)}: "
                "negated, or propellers of the other direction?"
            )
    return "; ".join(parts)


@dataclass(frozen=True)
class Motion:
    """Band-passed signals (n, k); all but the first two less what velocity and rates explain."""

    whole_turning: np.ndarray  # angular accelerations, 3 axes
    whole_squares: np.ndarray  # of the 4 motors' speeds, relative to their mean
    turning: np.ndarray
    squares: np.ndarray
    speeds: np.ndarray
    changes: np.ndarray  # their derivatives
    independent: float  # number of independent samples


def _motion(log: "FlightLog") -> Motion:
    rate = log.sample_rate
    filter_ = butter(2, (BAND[0], min(BAND[1], 0.4 * rate)), "band", fs=rate, output="sos")
    rows = inner_rows(log)

    def passed(values: np.ndarray, slope: bool = False) -> np.ndarray:
        # Filter first: the filter rings at the ends of the log where a derivative is noisy.
        smooth = sosfiltfilt(filter_, values, axis=0)
        return (derivative(smooth, rate) if slope else smooth)[rows]

    p, q, r = log.rates.T
    coupling = np.stack([q * r, r * p, p * q], axis=1)
    others = np.concatenate([log.body_velocity, log.rates, coupling], axis=1)
    basis = np.linalg.qr(passed(others))[0]

    def freed(values: np.ndarray, slope: bool = False) -> np.ndarray:
        own = passed(values, slope)
        return own - basis @ (basis.T @ own)

    rpm = log.rpm / log.rpm.mean()
    return Motion(
        whole_turning=passed(log.rates, slope=True),
        whole_squares=passed(rpm**2),
        turning=freed(log.rates, slope=True),
        squares=freed(rpm**2),
        speeds=freed(rpm),
        changes=freed(rpm, slope=True),
        independent=0.25 * 2.0 * (BAND[1] - BAND[0]) * len(rows) / rate,
    )


def _likelihoods(motion: Motion) -> list[np.ndarray]:
    """Log-likelihoods (3 axes, 2 signs) of each of ``ORDERS``, relative to no effect of motors."""
    result = []
    for order in ORDERS:
        signs = np.empty((3, 4))
        signs[:, list(order)] = SIGNS
        roll, pitch, yaw = signs
        effects = (
            [motion.squares @ roll],
            [motion.squares @ pitch],
            [motion.speeds @ yaw, motion.changes @ yaw],
        )
        gains = [
            [_explained(sign * motion.turning[:, axis], columns) for sign in (1.0, -1.0)]
            for axis, columns in enumerate(effects)
        ]
        result.append(-0.5 * motion.independent * np.log1p(-np.array(gains)))
    return result


def _explained(target: np.ndarray, columns: list[np.ndarray]) -> float:
    """Fraction of a signal (n,) that columns (n,) explain with non-negative factors."""
    matrix = np.stack(columns, axis=1)
    gram, product = matrix.T @ matrix, matrix.T @ target
    energy = float(target @ target)
    if energy * np.trace(gram) == 0.0:
        return 0.0
    # The Cholesky factor of the normal equations has the same least squares in few rows.
    factor = np.linalg.cholesky(gram + 1e-9 * np.trace(gram) * np.eye(len(columns)))
    projected = np.linalg.solve(factor, product)
    _, left = nnls(factor.T, projected)
    return min((float(projected @ projected) - left**2) / energy, 1.0 - 1e-9)
