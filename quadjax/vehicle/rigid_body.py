"""State of a rigid body with actuators, in the world and in the body frame."""

from typing import Any

from flax import struct

from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Vec3


class RigidBodyState(struct.PyTreeNode):
    """State of one drone."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    euler: Vec3 | Quaternion  # roll, pitch, yaw, rad, or a quaternion from body to world
    rates: Vec3  # p, q, r, rad/s, body
    actuators: Any  # a pytree of scalars: rotor speeds, a thrust, ..
    moment_ext: Vec3 | None = None  # external moment, N m or rad/s^2, body
    force_ext: Vec3 | None = None  # external specific force, m/s^2, body


class BodyState(struct.PyTreeNode):
    """What forces and moments depend on."""

    velocity: Vec3  # m/s, body
    rates: Vec3  # p, q, r, rad/s, body
    actuators: Any  # as in ``RigidBodyState``
    actuator_rate: Any  # their derivative, 1/s
