"""Frames and angles: world NED, body FRD, Euler angles (roll, pitch, yaw) in radians.

``R = Rz(psi) Ry(theta) Rx(phi)`` maps body to world. Everything here is for one drone;
batch with ``jax.vmap``.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Vec3

# pi/2 in three float32 parts, so that x - k pi/2 keeps its bits (Cody and Waite, 1980).
_HALF_PI_PARTS = (1.5703125, 4.837512969970703e-4, 7.549789948768648e-8)


@jax.custom_jvp
def sincos(angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine together, without branches.

    Range reduction to [-pi/4, pi/4] and two short polynomials (the minimax coefficients of
    the Cephes library's single-precision sine and cosine). In float32 the error is below 1e-7
    for angles within +-20 rad; float64 goes to the library functions.

    Args:
        angle: rad, any shape.

    Returns:
        The sine and the cosine, each of the shape of ``angle``.
    """
    if angle.dtype != jnp.float32:
        return jnp.sin(angle), jnp.cos(angle)
    quarter_turns = jnp.round(angle * (2.0 / jnp.pi))
    reduced = angle
    for part in _HALF_PI_PARTS:
        reduced = reduced - quarter_turns * part
    square = reduced * reduced
    sine = reduced + reduced * square * (
        -1.6666654611e-1 + square * (8.3321608736e-3 - square * 1.9515295891e-4)
    )
    cosine = 1.0 - square * (
        0.5
        - square
        * (4.166664568298827e-2 + square * (-1.388731625493765e-3 + square * 2.443315711809948e-5))
    )
    quadrant = quarter_turns - 4.0 * jnp.floor(quarter_turns * 0.25)
    odd = (quadrant == 1.0) | (quadrant == 3.0)
    sine_sign = jnp.where(quadrant >= 2.0, -1.0, 1.0)
    cosine_sign = jnp.where((quadrant == 1.0) | (quadrant == 2.0), -1.0, 1.0)
    return (
        sine_sign * jnp.where(odd, cosine, sine),
        cosine_sign * jnp.where(odd, sine, cosine),
    )


@sincos.defjvp
def _sincos_jvp(
    primals: tuple[jax.Array], tangents: tuple[jax.Array]
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    sine, cosine = sincos(primals[0])
    return (sine, cosine), (cosine * tangents[0], -sine * tangents[0])


def wrap_angle(angle: jax.Array) -> jax.Array:
    """The same angle within [-pi, pi], rad; its derivative is one everywhere."""
    return angle - (2.0 * jnp.pi) * jax.lax.stop_gradient(jnp.round(angle / (2.0 * jnp.pi)))


@struct.dataclass
class Attitude:
    """Sines and cosines of the Euler angles, computed once for all uses."""

    sin_roll: jax.Array
    cos_roll: jax.Array
    sin_pitch: jax.Array
    cos_pitch: jax.Array
    sin_yaw: jax.Array
    cos_yaw: jax.Array


def attitude(euler: Vec3) -> Attitude:
    """Trigonometry of Euler angles (roll, pitch, yaw), rad."""
    return Attitude(*sincos(euler.x), *sincos(euler.y), *sincos(euler.z))


def rotation_matrix(euler: Vec3) -> jax.Array:
    """Body-to-world rotation ``Rz(psi) Ry(theta) Rx(phi)``, (3, 3), of Euler angles, rad."""
    a = attitude(euler)
    columns = [body_to_world(a, Vec3.of(unit)).array() for unit in jnp.eye(3)]
    return jnp.stack(columns, axis=-1)


def body_to_world(a: Attitude, vector: Vec3) -> Vec3:
    """Rotate a body-frame vector into the world frame."""
    x, y, z = vector.x, vector.y, vector.z
    # Rx, then Ry, then Rz.
    y, z = a.cos_roll * y - a.sin_roll * z, a.sin_roll * y + a.cos_roll * z
    x, z = a.cos_pitch * x + a.sin_pitch * z, -a.sin_pitch * x + a.cos_pitch * z
    x, y = a.cos_yaw * x - a.sin_yaw * y, a.sin_yaw * x + a.cos_yaw * y
    return Vec3(x, y, z)


def world_to_body(a: Attitude, vector: Vec3) -> Vec3:
    """Rotate a world-frame vector into the body frame."""
    x, y, z = vector.x, vector.y, vector.z
    x, y = a.cos_yaw * x + a.sin_yaw * y, -a.sin_yaw * x + a.cos_yaw * y
    x, z = a.cos_pitch * x - a.sin_pitch * z, a.sin_pitch * x + a.cos_pitch * z
    y, z = a.cos_roll * y + a.sin_roll * z, -a.sin_roll * y + a.cos_roll * z
    return Vec3(x, y, z)


def euler_rates(a: Attitude, body_rates: Vec3) -> Vec3:
    """Euler angle derivatives ``Q(lambda) Omega``, rad/s, of body rates (p, q, r), rad/s.

    Singular at pitch +-90 deg; the race ends an episode before that.
    """
    p, q, r = body_rates.x, body_rates.y, body_rates.z
    around_world_down = (a.sin_roll * q + a.cos_roll * r) / a.cos_pitch
    return Vec3(
        p + a.sin_pitch * around_world_down, a.cos_roll * q - a.sin_roll * r, around_world_down
    )
