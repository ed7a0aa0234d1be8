"""Physical constants of a vehicle, as pytrees of scalars, so that each can be traced and drawn.

The values of the Bebop 1 are in ``configs/vehicles/bebop1.yaml``; the symbols are those of
Ferede et al. (arXiv 2311.16948, arXiv 2304.13460).
"""

import dataclasses

import jax
from flax import struct

Scalar = jax.Array | float


@struct.dataclass
class MotorConstants:
    """Constants of the motor-level (E2E) model."""

    g: Scalar  # gravity, m/s^2
    i_xx: Scalar  # inertia, kg m^2
    i_yy: Scalar
    i_zz: Scalar
    k_x: Scalar  # rotor drag, 1/(s rpm)
    k_y: Scalar
    k_z: Scalar
    k_w: Scalar  # thrust, m/s^2/rpm^2
    k_h: Scalar  # translational lift, 1/m
    k_p: Scalar  # roll moment, N m/rpm^2
    k_q: Scalar  # pitch moment, N m/rpm^2
    k_pv: Scalar  # roll moment of sideways flight, N s
    k_qv: Scalar  # pitch moment of forward flight, N s
    k_r1: Scalar  # yaw moment of rotor drag, N m/rpm
    k_r2: Scalar  # yaw moment of rotor acceleration, N m s/rpm
    k_rr: Scalar  # yaw damping, N m s
    tau: Scalar  # motor time constant, s
    rpm_min: Scalar  # rpm
    rpm_max: Scalar  # rpm


@struct.dataclass
class RateConstants:
    """Constants of the rate-and-thrust (INDI) model."""

    g: Scalar  # gravity, m/s^2
    d_x: Scalar  # linear drag, 1/s
    d_y: Scalar
    tau_rate: Scalar  # body rate time constant, s
    tau_thrust: Scalar  # thrust time constant, s
    p_max: Scalar  # rate command limits, rad/s
    q_max: Scalar
    r_max: Scalar
    thrust_min: Scalar  # specific thrust command limits, m/s^2
    thrust_max: Scalar


Constants = MotorConstants | RateConstants


def constant_names(kind: type[Constants]) -> tuple[str, ...]:
    """The field names of a set of constants, in order."""
    return tuple(field.name for field in dataclasses.fields(kind))
