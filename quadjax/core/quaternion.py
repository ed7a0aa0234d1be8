"""Unit quaternions as attitude, without the singularity of Euler angles at a pitch of 90 deg.

Hamilton's convention, scalar first, body to world: ``v_world = q * v_body * q^-1`` (Sola,
"Quaternion kinematics for the error-state Kalman filter", arXiv 1711.02508, sections 1 and 2).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.trigonometry import sincos
from quadjax.core.vectors import Mat3, Vec3, dot

Arctan2 = Callable[[jax.Array, jax.Array], jax.Array]


class Quaternion(struct.PyTreeNode):
    """A rotation from body to world; each component ()."""

    w: jax.Array
    x: jax.Array
    y: jax.Array
    z: jax.Array


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """The product ``a * b``: the rotation ``b`` followed by ``a``."""
    return Quaternion(
        a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z,
        a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
        a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x,
        a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The inverse rotation."""
    return Quaternion(q.w, -q.x, -q.y, -q.z)


def normalized(q: Quaternion) -> Quaternion:
    """The quaternion scaled to unit length."""
    scale = jax.lax.rsqrt(q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z)
    return Quaternion(q.w * scale, q.x * scale, q.y * scale, q.z * scale)


def exponential(angle: Vec3) -> Quaternion:
    """The rotation by a rotation vector, rad.

    Uses the power series of sine and cosine of half the angle, exact in float32 for angles up to
    half a radian. The result always has unit length.
    """
    square = 0.25 * dot(angle, angle)
    half = 0.5 - square * (1.0 / 12.0 - square * (1.0 / 240.0))
    cosine = 1.0 - square * (0.5 - square * (1.0 / 24.0 - square * (1.0 / 720.0)))
    return normalized(Quaternion(cosine, half * angle.x, half * angle.y, half * angle.z))


def logarithm(q: Quaternion) -> Vec3:
    """The rotation vector of a unit quaternion, rad, of length at most pi."""
    square = q.x * q.x + q.y * q.y + q.z * q.z
    large = square > 1e-8
    length = jnp.sqrt(jnp.where(large, square, 1.0))
    w = jnp.abs(q.w)
    factor = jnp.where(large, 2.0 * jnp.arctan2(length, w) / length, 2.0)
    factor = jnp.where(q.w < 0, -factor, factor)
    return Vec3(factor * q.x, factor * q.y, factor * q.z)


def matrix(q: Quaternion) -> Mat3:
    """The rotation matrix, body to world."""
    xx, yy, zz = 2.0 * q.x * q.x, 2.0 * q.y * q.y, 2.0 * q.z * q.z
    xy, xz, yz = 2.0 * q.x * q.y, 2.0 * q.x * q.z, 2.0 * q.y * q.z
    wx, wy, wz = 2.0 * q.w * q.x, 2.0 * q.w * q.y, 2.0 * q.w * q.z
    return Mat3(
        Vec3(1.0 - yy - zz, xy - wz, xz + wy),
        Vec3(xy + wz, 1.0 - xx - zz, yz - wx),
        Vec3(xz - wy, yz + wx, 1.0 - xx - yy),
    )


def of_euler(euler: Vec3) -> Quaternion:
    """The attitude of Euler angles (roll, pitch, yaw), rad: ``Rz(psi) Ry(theta) Rx(phi)``."""
    sin_roll, cos_roll = sincos(0.5 * euler.x)
    sin_pitch, cos_pitch = sincos(0.5 * euler.y)
    sin_yaw, cos_yaw = sincos(0.5 * euler.z)
    return Quaternion(
        cos_yaw * cos_pitch * cos_roll + sin_yaw * sin_pitch * sin_roll,
        cos_yaw * cos_pitch * sin_roll - sin_yaw * sin_pitch * cos_roll,
        cos_yaw * sin_pitch * cos_roll + sin_yaw * cos_pitch * sin_roll,
        sin_yaw * cos_pitch * cos_roll - cos_yaw * sin_pitch * sin_roll,
    )


def to_euler(q: Quaternion, arctan2: Arctan2 = jnp.arctan2) -> Vec3:
    """Euler angles (roll, pitch, yaw), rad; pitch in [-pi/2, pi/2].

    With ``quadjax.core.trigonometry.arctan2`` the derivatives are finite at any attitude.
    """
    r = matrix(q)
    square = r.x.x * r.x.x + r.y.x * r.y.x
    flat = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
    return Vec3(arctan2(r.z.y, r.z.z), arctan2(-r.z.x, flat), arctan2(r.y.x, r.x.x))


def rate(q: Quaternion, body_rates: Vec3) -> Quaternion:
    """The derivative ``q * (0, Omega) / 2``, 1/s, of body rates (p, q, r), rad/s."""
    half = body_rates * 0.5
    return multiply(q, Quaternion(jnp.zeros_like(half.x), *half.components()))
