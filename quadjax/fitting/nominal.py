"""Force and moment model over whole logs, in float64: nominal part, residual and regressors.

The nominal model (``quadjax.vehicle.motor``) is linear in its constants: each axis of ``AXES`` is a
sum of ``constant * regressor``.
"""

from dataclasses import fields

import numpy as np
from flax import struct

from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.signals import Rows
from quadjax.vehicle.constants import MotorConstants
from quadjax.vehicle.motor import nominal_force, nominal_moment
from quadjax.vehicle.residual import Layers, Residual

AXES = ("ax", "ay", "az", "Mx", "My", "Mz")
UNITS = dict.fromkeys(AXES[:3], "m/s^2") | dict.fromkeys(AXES[3:], "N m")
CONSTANTS: dict[str, tuple[str, ...]] = {
    "ax": ("k_x",),
    "ay": ("k_y",),
    "az": ("k_w", "k_z", "k_h"),
    "Mx": ("k_p", "k_pv"),
    "My": ("k_q", "k_qv"),
    "Mz": ("k_r1", "k_r2", "k_rr"),
}


@struct.dataclass
class ModelInputs(Rows):
    """Inputs of the model, n samples."""

    rpm: np.ndarray  # (n, 4) rpm
    rpm_rate: np.ndarray  # (n, 4) rpm/s
    body_velocity: np.ndarray  # (n, 3) m/s
    rates: np.ndarray  # (n, 3) rad/s


def nominal(constants: MotorConstants, motion: ModelInputs) -> np.ndarray:
    """Specific forces, m/s^2, and moments, N m, of the nominal model: (n, 6), as ``AXES``."""
    numbers = {item.name: float(getattr(constants, item.name)) for item in fields(constants)}
    c = MotorConstants(**numbers)
    rpm, rpm_rate = Rotors.of(motion.rpm), Rotors.of(motion.rpm_rate)
    velocity, rates = Vec3.of(motion.body_velocity), Vec3.of(motion.rates)
    force = nominal_force(c, rpm, velocity)
    moment = nominal_moment(c, rpm, rpm_rate, velocity, rates)
    return np.stack([*force.components(), *moment.components()], axis=1)


def regressors(motion: ModelInputs) -> dict[str, np.ndarray]:
    """For each axis a column per constant of ``CONSTANTS``: (n, k)."""
    zero = MotorConstants(**dict.fromkeys((item.name for item in fields(MotorConstants)), 0.0))
    return {
        axis: np.stack(
            [nominal(zero.replace(**{name: 1.0}), motion)[:, AXES.index(axis)] for name in names],
            axis=1,
        )
        for axis, names in CONSTANTS.items()
    }


def file_inputs(motion: ModelInputs, rpm_range: tuple[float, float]) -> np.ndarray:
    """Inputs (n, 10) in the units of a residual file: rpm in [-1, 1], the rest in SI."""
    low, high = rpm_range
    rpm = 2.0 * (motion.rpm - low) / (high - low) - 1.0
    return np.concatenate([rpm, motion.body_velocity, motion.rates], axis=1)


def residual_output(residual: Residual, motion: ModelInputs) -> np.ndarray:
    """Output (n, 4) of the residual networks: az, m/s^2, and moments, N m."""
    inputs = file_inputs(motion, (float(residual.rpm_min), float(residual.rpm_max)))
    force = float(residual.thrust_sign) * evaluate(residual.thrust, inputs[:, :7])
    return np.concatenate([force, evaluate(residual.moment, inputs)], axis=1)


def evaluate(layers: Layers, inputs: np.ndarray) -> np.ndarray:
    """``quadjax.core.mlp.apply`` of a ReLU network in float64."""
    for kernel, bias in layers[:-1]:
        inputs = np.maximum(inputs @ np.float64(kernel) + np.float64(bias), 0.0)
    kernel, bias = layers[-1]
    return inputs @ np.float64(kernel) + np.float64(bias)


def angular_moment(
    constants: MotorConstants, rates: np.ndarray, rate_derivative: np.ndarray
) -> np.ndarray:
    """Total moment ``I Omega' + Omega x I Omega`` (n, 3), N m.

    Args:
        constants: with the inertia, kg m^2.
        rates: body rates (n, 3), rad/s.
        rate_derivative: their derivatives (n, 3), rad/s^2.
    """
    inertia = np.array([float(getattr(constants, name)) for name in ("i_xx", "i_yy", "i_zz")])
    return inertia * rate_derivative + np.cross(rates, inertia * rates)
