"""State and rotation of a rigid body: what the equations of all shipped vehicle models share."""

from typing import Any

from flax import struct

from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Vec3


@struct.dataclass
class RigidBodyState:
    """State of one drone."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    euler: Vec3 | Quaternion  # roll, pitch, yaw, rad, or a quaternion from body to world
    rates: Vec3  # p, q, r, rad/s, body
    actuators: Any  # a pytree of scalars: rotor speeds, a thrust, ..
    moment_ext: Vec3 | None = None  # external moment, N m or rad/s^2, body
    force_ext: Vec3 | None = None  # external specific force, m/s^2, body


@struct.dataclass
class BodyState:
    """What forces and moments depend on."""

    velocity: Vec3  # m/s, body
    rates: Vec3  # p, q, r, rad/s, body
    actuators: Any  # as in ``RigidBodyState``
    actuator_rate: Any  # their derivative, 1/s


def angular_acceleration(c: Any, moment: Vec3, rates: Vec3) -> Vec3:
    """``I^-1 (M - Omega x I Omega)``, rad/s^2, body frame, of a moment, N m, and rates, rad/s."""
    p, q, r = rates.x, rates.y, rates.z
    return Vec3(
        (moment.x + (c.i_yy - c.i_zz) * q * r) / c.i_xx,
        (moment.y + (c.i_zz - c.i_xx) * r * p) / c.i_yy,
        (moment.z + (c.i_xx - c.i_yy) * p * q) / c.i_zz,
    )


def gyroscopic_moment(c: Any, rates: Vec3) -> Vec3:
    """``Omega x I Omega``, N m, body frame, of rates, rad/s."""
    p, q, r = rates.x, rates.y, rates.z
    return Vec3((c.i_zz - c.i_yy) * q * r, (c.i_xx - c.i_zz) * r * p, (c.i_yy - c.i_xx) * p * q)
