"""The nominal force and moment model as a matrix of regressors, in float64 NumPy.

The model of Ferede et al. (arXiv 2311.16948) is linear in its constants, axis by axis: each axis of
``AXES`` is a sum of ``constant * regressor``. It is the model of ``quadjax.vehicle.motor``, over
whole logs and in double precision; the tests hold the two against each other.
"""

from dataclasses import dataclass

import numpy as np

from quadjax.vehicle.constants import MotorConstants

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
    """For each axis, a column (n,) per constant of ``CONSTANTS``, stacked to (n, k)."""
    w, s = motion.rpm, motion.rpm**2
    vx, vy, vz = motion.body_velocity.T
    total = w.sum(1)
    columns = {
        "ax": [-vx * total],
        "ay": [-vy * total],
        "az": [-s.sum(1), -vz * total, -(vx**2 + vy**2)],
        "Mx": [s @ (1.0, -1.0, -1.0, 1.0), vy],
        "My": [s @ (1.0, 1.0, -1.0, -1.0), vx],
        "Mz": [
            w @ (-1.0, 1.0, -1.0, 1.0),
            motion.rpm_rate @ (-1.0, 1.0, -1.0, 1.0),
            -motion.rates[:, 2],
        ],
    }
    return {axis: np.stack(parts, axis=1) for axis, parts in columns.items()}


def nominal(constants: MotorConstants, motion: Motion) -> np.ndarray:
    """Specific forces, m/s^2, and moments, N m, of the nominal model: (n, 6), ordered as AXES."""
    parts = regressors(motion)
    return np.stack(
        [
            parts[axis] @ np.array([float(getattr(constants, name)) for name in CONSTANTS[axis]])
            for axis in AXES
        ],
        axis=1,
    )


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
