"""Frames and angles: world NED, body FRD, Euler angles (roll, pitch, yaw) in radians.

``R = Rz(psi) Ry(theta) Rx(phi)`` maps body to world. ``attitude`` takes Euler angles or a unit
quaternion; the functions of its result are for both. Everything here is for one drone; batch with
``jax.vmap``.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import quaternion
from quadjax.core.materialize import materialized
from quadjax.core.quaternion import Quaternion
from quadjax.core.trigonometry import sincos
from quadjax.core.vectors import Mat3, Vec3, apply, apply_transposed


def wrap_angle(angle: jax.Array) -> jax.Array:
    """The same angle within [-pi, pi], rad; its derivative is one everywhere."""
    return angle - (2.0 * jnp.pi) * jax.lax.stop_gradient(jnp.round(angle / (2.0 * jnp.pi)))


class QuaternionAttitude(struct.PyTreeNode):
    """A quaternion and its rotation matrix, computed once for all uses."""

    quaternion: Quaternion
    matrix: Mat3


class Attitude(struct.PyTreeNode):
    """Sines and cosines of the Euler angles, computed once for all uses."""

    sin_roll: jax.Array
    cos_roll: jax.Array
    sin_pitch: jax.Array
    cos_pitch: jax.Array
    sin_yaw: jax.Array
    cos_yaw: jax.Array


@materialized()
def attitude(euler: Vec3 | Quaternion) -> Attitude | QuaternionAttitude:
    """The argument of the functions below, from roll, pitch and yaw, rad, or a quaternion."""
    if isinstance(euler, Quaternion):
        return QuaternionAttitude(euler, quaternion.matrix(euler))
    return Attitude(*sincos(euler.x), *sincos(euler.y), *sincos(euler.z))


def body_to_world(a: Attitude | QuaternionAttitude, vector: Vec3) -> Vec3:
    """Rotate a body-frame vector into the world frame."""
    if isinstance(a, QuaternionAttitude):
        return apply(a.matrix, vector)
    x, y, z = vector.x, vector.y, vector.z
    # Rx, then Ry, then Rz.
    y, z = a.cos_roll * y - a.sin_roll * z, a.sin_roll * y + a.cos_roll * z
    x, z = a.cos_pitch * x + a.sin_pitch * z, -a.sin_pitch * x + a.cos_pitch * z
    x, y = a.cos_yaw * x - a.sin_yaw * y, a.sin_yaw * x + a.cos_yaw * y
    return Vec3(x, y, z)


@materialized()
def world_to_body(a: Attitude | QuaternionAttitude, vector: Vec3) -> Vec3:
    """Rotate a world-frame vector into the body frame."""
    if isinstance(a, QuaternionAttitude):
        return apply_transposed(a.matrix, vector)
    x, y, z = vector.x, vector.y, vector.z
    x, y = a.cos_yaw * x + a.sin_yaw * y, -a.sin_yaw * x + a.cos_yaw * y
    x, z = a.cos_pitch * x - a.sin_pitch * z, a.sin_pitch * x + a.cos_pitch * z
    y, z = a.cos_roll * y + a.sin_roll * z, -a.sin_roll * y + a.cos_roll * z
    return Vec3(x, y, z)


def euler_rates(a: Attitude | QuaternionAttitude, body_rates: Vec3) -> Vec3 | Quaternion:
    """The attitude's derivative, 1/s, for body rates (p, q, r), rad/s.

    For Euler angles ``Q(lambda) Omega``, which is singular at pitch +-90 deg; the race ends an
    episode before that. For a quaternion ``q * (0, Omega) / 2``.
    """
    if isinstance(a, QuaternionAttitude):
        return quaternion.rate(a.quaternion, body_rates)
    p, q, r = body_rates.x, body_rates.y, body_rates.z
    around_world_down = (a.sin_roll * q + a.cos_roll * r) / a.cos_pitch
    return Vec3(
        p + a.sin_pitch * around_world_down, a.cos_roll * q - a.sin_roll * r, around_world_down
    )
