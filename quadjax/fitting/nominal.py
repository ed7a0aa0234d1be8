"""The nominal force and moment model as a matrix of regressors, in float64 NumPy.

The model of ``quadjax.vehicle.motor`` is linear in its constants, axis by axis: each axis of
``AXES`` is a sum of ``constant * regressor``.
"""

from dataclasses import dataclass

import numpy as np

from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle.constants import MotorConstants, constant_names
from quadjax.vehicle.motor import nominal_force, nominal_moment

AXES = ("ax", "ay", "az", "Mx", "My", "Mz")
FORCE_AXES, MOMENT_AXES = AXES[:3], AXES[3:]
UNITS = {axis: "m/s^2" for axis in FORCE_AXES} | {axis: "N m" for axis in MOMENT_AXES}
CONSTANTS: dict[str, tuple[str, ...]] = {
    "ax": ("k_x",),
    "ay": ("k_y",),
    "az": ("k_w", "k_z", "k_h"),
    "Mx": ("k_p", "k_pv"),
    "My": ("k_q", "k_qv"),
    "Mz": ("k_r1", "k_r2", "k_rr"),
}


@dataclass(frozen=True)
class Motion:
    """What the model is computed from, n samples of it."""

    rpm: np.ndarray  # (n, 4) rpm
    rpm_rate: np.ndarray  # (n, 4) rpm/s
    body_velocity: np.ndarray  # (n, 3) m/s
    rates: np.ndarray  # (n, 3) rad/s

    def __getitem__(self, rows: slice | np.ndarray) -> "Motion":
        """Some of the samples."""
        return Motion(
            self.rpm[rows], self.rpm_rate[rows], self.body_velocity[rows], self.rates[rows]
        )


def regressors(motion: Motion) -> dict[str, np.ndarray]:
    """For each axis, a column (n,) per constant of ``CONSTANTS``, stacked to (n, k).

    A column is what the vehicle's equations give with that constant one and all others zero.
    """
    return {
        axis: np.stack([_evaluate({name: 1.0}, motion)[:, index] for name in CONSTANTS[axis]], 1)
        for index, axis in enumerate(AXES)
    }


def nominal(constants: MotorConstants, motion: Motion) -> np.ndarray:
    """Specific forces, m/s^2, and moments, N m, of the nominal model: (n, 6), ordered as AXES."""
    return _evaluate({name: float(value) for name, value in vars(constants).items()}, motion)


def _evaluate(values: dict[str, float], motion: Motion) -> np.ndarray:
    """The equations of ``quadjax.vehicle.motor`` in float64, (n, 6); other constants are zero."""
    c = MotorConstants(**dict.fromkeys(constant_names(MotorConstants), 0.0) | values)
    rpm, rpm_rate = Rotors(*motion.rpm.T), Rotors(*motion.rpm_rate.T)
    velocity, rates = Vec3(*motion.body_velocity.T), Vec3(*motion.rates.T)
    force = nominal_force(c, rpm, velocity)
    moment = nominal_moment(c, rpm, rpm_rate, velocity, rates)
    return np.stack([*force.components(), *moment.components()], axis=1)


def angular_moment(
    constants: MotorConstants, rates: np.ndarray, rate_derivative: np.ndarray
) -> np.ndarray:
    """Total moment ``I Omega' + Omega x I Omega`` (n, 3), N m.

    Args:
        constants: for the inertia, kg m^2.
        rates: body rates (n, 3), rad/s.
        rate_derivative: their derivatives (n, 3), rad/s^2.
    """
    inertia = np.array([float(getattr(constants, name)) for name in ("i_xx", "i_yy", "i_zz")])
    return inertia * rate_derivative + np.cross(rates, inertia * rates)
