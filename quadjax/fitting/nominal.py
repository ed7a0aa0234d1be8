"""Force and moment model over whole logs, in float64: nominal part, residual and regressors.

The nominal models (``quadjax.vehicle.motor``, ``racing`` and the drag of ``rate``) are linear in
their constants: each axis of ``AXES`` is a sum of ``constant * regressor``. Moments are those of
the inertia (motor) or angular accelerations (racing).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from flax import struct

from quadjax.core.mlp import Layers, to_layers
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.signals import Rows
from quadjax.vehicle import motor, racing
from quadjax.vehicle.constants import from_values, replaced, rotor_names, values_of
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.racing import RacingConstants
from quadjax.vehicle.rate import RateConstants
from quadjax.vehicle.residual import Residual

Constants = MotorConstants | RacingConstants | RateConstants
ForceMoment = Callable[[Any, Rotors, Rotors, Vec3, Vec3], tuple[Vec3, Vec3]]
AXES = ("ax", "ay", "az", "Mx", "My", "Mz")
UNITS = dict.fromkeys(AXES[:3], "m/s^2") | dict.fromkeys(AXES[3:], "N m")  # of motor
CONSTANTS: dict[str, tuple[str, ...]] = {
    "ax": ("k_x",),
    "ay": ("k_y",),
    "az": ("k_w", "k_z", "k_h"),
    "Mx": ("k_p", "k_pv"),
    "My": ("k_q", "k_qv"),
    "Mz": ("k_r1", "k_r2", "k_rr"),
}
RACING_CONSTANTS = CONSTANTS | {
    **{"az": ("k_w",), "Mx": rotor_names("k_p"), "My": rotor_names("k_q")},
    "Mz": (*rotor_names("k_r"), *rotor_names("k_rd")),
}


@dataclass(frozen=True)
class Equations:
    """The equations of a model that is linear in its constants."""

    # names by axis; positive on every drone, except for those of either sign
    constants: dict[str, tuple[str, ...]]
    small: tuple[str, ...]  # names of those that may absorb what the model lacks
    force_moment: ForceMoment  # of constants, rpm, their derivatives, body velocity and rates
    either_sign: tuple[str, ...] = ()  # names of constants that may be negative
    has_inertia: bool = False  # whether the moments are N m, else rad/s^2
    uncertain: float = 0.05  # relative standard error above which a constant has a warning


def _motor(
    c: MotorConstants, rpm: Rotors, rpm_rate: Rotors, velocity: Vec3, rates: Vec3
) -> tuple[Vec3, Vec3]:
    return (
        motor.nominal_force(c, rpm, velocity),
        motor.nominal_moment(c, rpm, rpm_rate, velocity, rates),
    )


def _racing(
    c: RacingConstants, rpm: Rotors, rpm_rate: Rotors, velocity: Vec3, _rates: Vec3
) -> tuple[Vec3, Vec3]:
    speed, speed_rate = (values * (math.pi / 30.0) for values in (rpm, rpm_rate))
    return racing.nominal_force(c, speed, velocity), racing.nominal_spin(c, speed, speed_rate)


def _rate(
    c: RateConstants, rpm: Rotors, _rpm_rate: Rotors, velocity: Vec3, _rates: Vec3
) -> tuple[Vec3, Vec3]:
    nothing = 0.0 * rpm.w1
    return Vec3(-c.d_x * velocity.x, -c.d_y * velocity.y, nothing), Vec3(*[nothing] * 3)


EQUATIONS: dict[type, Equations] = {
    RateConstants: Equations({"ax": ("d_x",), "ay": ("d_y",)}, ("d_x", "d_y"), _rate),
    MotorConstants: Equations(
        CONSTANTS, ("k_z", "k_h", "k_rr"), _motor, either_sign=("k_pv", "k_qv"), has_inertia=True
    ),
    RacingConstants: Equations(RACING_CONSTANTS, rotor_names("k_rd"), _racing, uncertain=0.01),
}


def units(kind: type) -> dict[str, str]:
    """The unit of each of ``AXES``, by the type of a model's constants."""
    moment = "N m" if EQUATIONS[kind].has_inertia else "rad/s^2"
    return UNITS | dict.fromkeys(AXES[3:], moment)


class ModelInputs(struct.PyTreeNode, Rows):
    """Inputs of the model, n samples."""

    rpm: np.ndarray  # (n, 4) rpm
    rpm_rate: np.ndarray  # (n, 4) rpm/s
    body_velocity: np.ndarray  # (n, 3) m/s
    rates: np.ndarray  # (n, 3) rad/s


def nominal(constants: Constants, motion: ModelInputs) -> np.ndarray:
    """Specific forces, m/s^2, and moments of the nominal model: (n, 6), as ``AXES``."""
    numbers = {name: float(value) for name, value in values_of(constants).items()}
    rpm, rpm_rate = Rotors(*motion.rpm.T), Rotors(*motion.rpm_rate.T)
    velocity, rates = Vec3(*motion.body_velocity.T), Vec3(*motion.rates.T)
    force_moment = EQUATIONS[type(constants)].force_moment
    model = from_values(type(constants), numbers)
    parts = force_moment(model, rpm, rpm_rate, velocity, rates)
    return np.stack([number for part in parts for number in part.components()], axis=1)


def regressors(motion: ModelInputs, constants: Constants) -> dict[str, np.ndarray]:
    """For each axis a column per constant of the ``EQUATIONS`` of a model's constants: (n, k)."""
    axes = EQUATIONS[type(constants)].constants
    zero = replaced(constants, dict.fromkeys((n for names in axes.values() for n in names), 0.0))
    return {
        axis: np.stack(
            [nominal(replaced(zero, {name: 1.0}), motion)[:, AXES.index(axis)] for name in names],
            axis=1,
        )
        for axis, names in axes.items()
    }


def angular_moment(
    constants: Constants, rates: np.ndarray, rate_derivative: np.ndarray
) -> np.ndarray:
    """Total moment ``I Omega' + Omega x I Omega``, N m, or ``Omega'``, rad/s^2: (n, 3).

    Args:
        constants: with the inertia, kg m^2, if the model has one.
        rates: body rates (n, 3), rad/s.
        rate_derivative: their derivatives (n, 3), rad/s^2.
    """
    if not EQUATIONS[type(constants)].has_inertia:
        return rate_derivative
    inertia = np.array([float(getattr(constants, name)) for name in ("i_xx", "i_yy", "i_zz")])
    return inertia * rate_derivative + np.cross(rates, inertia * rates)


def file_inputs(motion: ModelInputs, rpm_range: tuple[float, float]) -> np.ndarray:
    """Inputs (n, 10) in the units of a residual file: rpm in [-1, 1], the rest in SI."""
    low, high = rpm_range
    rpm = 2.0 * (motion.rpm - low) / (high - low) - 1.0
    return np.concatenate([rpm, motion.body_velocity, motion.rates], axis=1)


def residual_output(residual: Residual, motion: ModelInputs) -> np.ndarray:
    """Output (n, 4) of the residual networks: az, m/s^2, and moments, N m."""
    inputs = file_inputs(motion, (float(residual.rpm_min), float(residual.rpm_max)))
    residual = residual.with_gain_in_layers()
    force = float(residual.thrust_sign) * evaluate(to_layers(residual.thrust), inputs[:, :7])
    return np.concatenate([force, evaluate(to_layers(residual.moment), inputs)], axis=1)


def evaluate(layers: Layers, inputs: np.ndarray) -> np.ndarray:
    """``quadjax.core.mlp.apply`` of a ReLU network in float64."""
    for kernel, bias in layers[:-1]:
        inputs = np.maximum(inputs @ np.float64(kernel) + np.float64(bias), 0.0)
    kernel, bias = layers[-1]
    return inputs @ np.float64(kernel) + np.float64(bias)
