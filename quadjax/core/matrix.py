"""3 x 3 matrices as separate scalars; see ``quadjax.core.vectors`` for the reason."""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Vec3, dot


@struct.dataclass
class Mat3:
    """A 3 x 3 matrix by its rows."""

    x: Vec3
    y: Vec3
    z: Vec3

    def rows(self) -> tuple[Vec3, Vec3, Vec3]:
        """The rows in order."""
        return self.x, self.y, self.z

    def array(self) -> jax.Array:
        """The matrix (3, 3)."""
        return jnp.stack([row.array() for row in self.rows()])


def apply(m: Mat3, v: Vec3) -> Vec3:
    """``M v``."""
    return Vec3(dot(m.x, v), dot(m.y, v), dot(m.z, v))


def apply_transposed(m: Mat3, v: Vec3) -> Vec3:
    """``M^T v``."""
    return m.x * v.x + m.y * v.y + m.z * v.z


def skew(v: Vec3) -> Mat3:
    """``[v]x``, the matrix of ``v x``."""
    zero = jnp.zeros_like(v.x)
    return Mat3(Vec3(zero, -v.z, v.y), Vec3(v.z, zero, -v.x), Vec3(-v.y, v.x, zero))
