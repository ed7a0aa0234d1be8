"""Small vectors and 3 x 3 matrices as separate scalars.

A batch of drones then is a set of contiguous (drones,) arrays, over which XLA's CPU backend
vectorizes; stacked into (drones, 3) arrays the same simulator ran five times slower, because a
concatenation inside a fused loop is a branch per element.
"""

import dataclasses
from typing import TYPE_CHECKING, Any, ClassVar, Self

import jax
import jax.numpy as jnp
from flax import struct


class _Components:
    """Arithmetic, component by component, with another of the kind or with a scalar."""

    if TYPE_CHECKING:  # of flax dataclasses
        __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]

        def replace(self, **changes: jax.Array) -> Self: ...

    def _zip(
        self, other: "_Components | jax.Array | float"
    ) -> list[tuple[jax.Array, jax.Array | float]]:
        components = self.components()
        if isinstance(other, _Components):
            return list(zip(components, other.components(), strict=True))
        return [(component, other) for component in components]

    def components(self) -> tuple[jax.Array, ...]:
        """The components in order."""
        return tuple(getattr(self, field.name) for field in dataclasses.fields(self))

    def __getitem__(self, index: int) -> jax.Array:
        return self.components()[index]

    def __len__(self) -> int:
        return len(self.components())

    def __add__(self, other: Self | jax.Array | float) -> Self:
        return type(self)(*(a + b for a, b in self._zip(other)))

    def __sub__(self, other: Self | jax.Array | float) -> Self:
        return type(self)(*(a - b for a, b in self._zip(other)))

    def __mul__(self, other: Self | jax.Array | float) -> Self:
        return type(self)(*(a * b for a, b in self._zip(other)))

    __rmul__ = __mul__

    def __truediv__(self, other: Self | jax.Array | float) -> Self:
        return type(self)(*(a / b for a, b in self._zip(other)))

    def array(self) -> jax.Array:
        """The components along a new last axis: (n,) for one drone."""
        return jnp.stack([jnp.asarray(c) for c in self.components()], axis=-1)

    @classmethod
    def of(cls, array: jax.Array) -> Self:
        """From an array (.., n)."""
        return cls(*(array[..., i] for i in range(len(dataclasses.fields(cls)))))

    @classmethod
    def zero(cls) -> Self:
        """All components zero, each its own array."""
        return cls(*(jnp.zeros(()) for _ in dataclasses.fields(cls)))


class Vec3(_Components, struct.PyTreeNode):
    """Three components of a vector, in the frame that the field's comment gives."""

    x: jax.Array
    y: jax.Array
    z: jax.Array


class Rotors(_Components, struct.PyTreeNode):
    """One number per motor: 1 front-left, 2 front-right, 3 rear-right, 4 rear-left."""

    w1: jax.Array
    w2: jax.Array
    w3: jax.Array
    w4: jax.Array

    @classmethod
    def same(cls, value: jax.Array) -> Self:
        """The same number for every motor."""
        return cls(value, value, value, value)


def dot(a: Vec3, b: Vec3) -> jax.Array:
    """Inner product ()."""
    return a.x * b.x + a.y * b.y + a.z * b.z


def cross(a: Vec3, b: Vec3) -> Vec3:
    """Cross product."""
    return Vec3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x)


def safe_norm(vector: Vec3) -> jax.Array:
    """Euclidean length (), with a gradient of zero instead of NaN at the origin."""
    square = dot(vector, vector)
    positive = square > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)


def from_unit(low: jax.Array | float, high: jax.Array | float, draw: jax.Array) -> jax.Array:
    """A number of [-1, 1] mapped to [low, high]."""
    return low + 0.5 * (high - low) * (draw + 1.0)


class Mat3(struct.PyTreeNode):
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
