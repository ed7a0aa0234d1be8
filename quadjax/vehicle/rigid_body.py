"""State of a rigid body with actuators, in the world and in the body frame."""

from typing import Any, Self

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import quaternion
from quadjax.core.frames import attitude, world_to_body, wrap_angle
from quadjax.core.quaternion import Quaternion
from quadjax.core.trigonometry import arctan2
from quadjax.core.vectors import Vec3


class RigidBodyState(struct.PyTreeNode):
    """State of one drone."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    attitude: Vec3 | Quaternion  # roll, pitch, yaw, rad, or a quaternion from body to world
    rates: Vec3  # p, q, r, rad/s, body
    actuators: Any  # a pytree of scalars: rotor speeds, a thrust, ..
    moment_ext: Vec3 | None = None  # external moment, N m or rad/s^2, body
    force_ext: Vec3 | None = None  # external specific force, m/s^2, body

    @property
    def euler(self) -> Vec3:
        """Roll, pitch and yaw, rad."""
        found = self.attitude
        return quaternion.to_euler(found, arctan2) if isinstance(found, Quaternion) else found

    @property
    def disturbance(self) -> tuple[Vec3, Vec3]:
        """External moment and specific force of a model that has them."""
        assert self.moment_ext is not None and self.force_ext is not None
        return self.moment_ext, self.force_ext

    def to_body(self, vector: Vec3) -> Vec3:
        """A world-frame vector in the body frame."""
        return world_to_body(attitude(self.attitude), vector)

    def wrapped(self) -> Self:
        """The state with angles wrapped or the quaternion normalized, after each step."""
        now = self.attitude
        if isinstance(now, Quaternion):
            return self.replace(attitude=quaternion.normalized(now))
        return self.replace(attitude=now.replace(x=wrap_angle(now.x), z=wrap_angle(now.z)))


class BodyState(struct.PyTreeNode):
    """What forces and moments depend on."""

    velocity: Vec3  # m/s, body
    rates: Vec3  # p, q, r, rad/s, body
    actuators: Any  # as in ``RigidBodyState``
    actuator_rate: Any  # their derivative, 1/s

    @classmethod
    def steady(cls, velocity: Vec3, rates: Vec3, actuators: Any) -> Self:
        """A body whose actuators do not change."""
        return cls(velocity, rates, actuators, jax.tree.map(jnp.zeros_like, actuators))
