"""The numbers of the estimators on board: of external moment and force, and of the highest rpm."""

import dataclasses
from typing import Any

import jax
import numpy as np

from quadjax.core import mlp
from quadjax.core.errors import InputError
from quadjax.core.filters import butterworth
from quadjax.vehicle.battery import LOWEST, limit_estimator
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.residual import Residual

SAMPLE_RATE, CUTOFF = 512.0, 8.0  # Hz, if none are given
SAMPLE_RATES = (1.0, 1e5)  # Hz
CONSTANTS = ("k_w", "k_x", "k_y", "k_z", "k_h", "k_p", "k_q", "k_pv", "k_qv", "k_r1", "k_r2",
             "k_rr")  # fmt: skip


@dataclasses.dataclass(frozen=True)
class ResidualNumbers:
    """``qj_residual``: layers (rows, columns) and biases of both networks."""

    low_rpm: float
    high_rpm: float
    thrust: tuple[tuple[np.ndarray, np.ndarray], ...]
    moment: tuple[tuple[np.ndarray, np.ndarray], ...]


@dataclasses.dataclass(frozen=True)
class DisturbanceModel:
    """``qj_disturbance_model``: the vehicle that is subtracted, and the filter."""

    sample_rate: float  # Hz
    constants: dict[str, float]  # of ``CONSTANTS``
    inertia: tuple[float, float, float]  # kg m^2
    feedback: tuple[float, ...]
    low_pass: tuple[float, ...]
    derivative: tuple[float, ...]
    residual: ResidualNumbers | None


@dataclasses.dataclass(frozen=True)
class BatteryModel:
    """``qj_battery_model``; speeds in rpm."""

    sample_rate: float  # Hz
    lowest: float
    highest: float
    first: float  # estimate
    low_pass: float
    lead: float
    gain: float


def check_cutoff(sample_rate: float, cutoff: float) -> None:
    """Check the estimators' numbers, Hz.

    Raises:
        InputError: a sample rate or a cut-off that is not allowed.
    """
    low, high = SAMPLE_RATES
    if not low <= sample_rate <= high:
        raise InputError(
            f"estimator sample rate {sample_rate:g} Hz, allowed: {low:g} to {high:g} Hz"
        )
    if not 0.001 * sample_rate <= cutoff <= 0.25 * sample_rate:
        raise InputError(
            f"estimator cut-off {cutoff:g} Hz, allowed: {0.001 * sample_rate:g} to "
            f"{0.25 * sample_rate:g} Hz at a sample rate of {sample_rate:g} Hz"
        )


def make_disturbance_model(
    constants: MotorConstants, residual: Residual | None, sample_rate: float, cutoff: float
) -> DisturbanceModel:
    """The estimator of moment and force of one vehicle.

    Raises:
        InputError: see ``check_cutoff``.
    """
    check_cutoff(sample_rate, cutoff)
    low_pass = butterworth(float(sample_rate), float(cutoff))
    return DisturbanceModel(
        sample_rate=sample_rate,
        constants={name: float(getattr(constants, name)) for name in CONSTANTS},
        inertia=(float(constants.i_xx), float(constants.i_yy), float(constants.i_zz)),
        feedback=tuple(np.asarray(low_pass.feedback, np.float64).tolist()),
        low_pass=tuple(np.asarray(low_pass.forward, np.float64).tolist()),
        derivative=tuple(np.asarray(low_pass.derivative, np.float64).tolist()),
        residual=None if residual is None else _residual(residual),
    )


def _residual(residual: Residual) -> ResidualNumbers:
    residual = residual.with_gain_in_layers()
    thrust = _layers(residual.thrust)
    weights, bias = thrust[-1]
    sign = np.float32(residual.thrust_sign)
    ends = (float(residual.rpm_min), float(residual.rpm_max))
    return ResidualNumbers(
        *ends, (*thrust[:-1], (sign * weights, sign * bias)), _layers(residual.moment)
    )


def _layers(params: Any) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Weights (rows, columns) and biases of a network."""
    layers = jax.tree.map(np.asarray, mlp.to_layers(params))
    return tuple((kernel.T.astype(np.float32), bias.astype(np.float32)) for kernel, bias in layers)


def make_battery_model(constants: MotorConstants, first: float, sample_rate: float) -> BatteryModel:
    """The estimator of the highest rpm of one vehicle, with its first estimate, rpm."""
    numbers = limit_estimator(constants.rpm_max, constants.tau, sample_rate)
    highest = float(numbers.highest)
    return BatteryModel(
        sample_rate=sample_rate,
        lowest=LOWEST * highest,
        highest=highest,
        first=float(np.clip(first, LOWEST * highest, highest)),
        low_pass=float(numbers.low_pass),
        lead=float(numbers.lead),
        gain=float(numbers.gain),
    )
