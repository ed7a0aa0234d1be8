"""3 x 3 matrices as separate scalars; see ``quadjax.core.vectors`` for the reason."""

import dataclasses

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

    def __add__(self, other: "Mat3") -> "Mat3":
        return Mat3(*(a + b for a, b in zip(self.rows(), other.rows(), strict=True)))

    def __sub__(self, other: "Mat3") -> "Mat3":
        return Mat3(*(a - b for a, b in zip(self.rows(), other.rows(), strict=True)))

    def __mul__(self, factor: jax.Array | float) -> "Mat3":
        return Mat3(*(row * factor for row in self.rows()))

    def array(self) -> jax.Array:
        """The matrix (3, 3)."""
        return jnp.stack([row.array() for row in self.rows()])


@struct.dataclass
class Sym3:
    """A symmetric 3 x 3 matrix by its upper triangle: rounding cannot make it asymmetric."""

    xx: jax.Array
    xy: jax.Array
    xz: jax.Array
    yy: jax.Array
    yz: jax.Array
    zz: jax.Array

    @classmethod
    def isotropic(cls, value: jax.Array) -> "Sym3":
        """``value`` times the identity."""
        zero = jnp.zeros_like(value)
        return cls(value, zero, zero, value, zero, value)

    @classmethod
    def of(cls, m: Mat3) -> "Sym3":
        """The upper triangle of a matrix that is symmetric up to rounding."""
        return cls(m.x.x, m.x.y, m.x.z, m.y.y, m.y.z, m.z.z)

    def full(self) -> Mat3:
        """All nine entries."""
        return Mat3(
            Vec3(self.xx, self.xy, self.xz),
            Vec3(self.xy, self.yy, self.yz),
            Vec3(self.xz, self.yz, self.zz),
        )

    def diagonal(self) -> Vec3:
        """The diagonal."""
        return Vec3(self.xx, self.yy, self.zz)

    def plus(self, value: jax.Array) -> "Sym3":
        """``value`` added to the diagonal."""
        diagonal = {"xx": self.xx + value, "yy": self.yy + value, "zz": self.zz + value}
        return dataclasses.replace(self, **diagonal)


def transpose(m: Mat3) -> Mat3:
    """``M^T``."""
    return Mat3(*(Vec3(m.x[i], m.y[i], m.z[i]) for i in range(3)))


def times(a: Mat3, b: Mat3) -> Mat3:
    """``A B``."""
    return Mat3(*(b.x * row.x + b.y * row.y + b.z * row.z for row in a.rows()))


def times_transposed(a: Mat3, b: Mat3) -> Mat3:
    """``A B^T``."""
    return Mat3(*(Vec3(*(dot(row, other) for other in b.rows())) for row in a.rows()))


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


def skew_times(v: Vec3, m: Mat3) -> Mat3:
    """``[v]x M``."""
    return Mat3(m.z * v.y - m.y * v.z, m.x * v.z - m.z * v.x, m.y * v.x - m.x * v.y)


def times_skew(m: Mat3, v: Vec3) -> Mat3:
    """``M [v]x``: each row becomes ``row x v``."""
    return Mat3(
        *(
            Vec3(r.y * v.z - r.z * v.y, r.z * v.x - r.x * v.z, r.x * v.y - r.y * v.x)
            for r in m.rows()
        )
    )


def inverse(s: Sym3) -> Sym3:
    """The inverse of a symmetric positive definite matrix, by cofactors."""
    xx = s.yy * s.zz - s.yz * s.yz
    xy = s.xz * s.yz - s.xy * s.zz
    xz = s.xy * s.yz - s.xz * s.yy
    scale = 1.0 / (s.xx * xx + s.xy * xy + s.xz * xz)
    return Sym3(
        scale * xx,
        scale * xy,
        scale * xz,
        scale * (s.xx * s.zz - s.xz * s.xz),
        scale * (s.xy * s.xz - s.xx * s.yz),
        scale * (s.xx * s.yy - s.xy * s.xy),
    )
