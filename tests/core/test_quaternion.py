"""Quaternions and arctangent against the Euler angles and finite rotations."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core import frames, quaternion
from quadjax.core.trigonometry import arctan2
from quadjax.core.vectors import Vec3
from tests import reference as ref

DRAWN = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * [np.pi, np.pi / 2, np.pi]


def array(vectors: object) -> np.ndarray:
    return np.stack(jax.tree.leaves(vectors), axis=-1)


def drawn() -> quaternion.Quaternion:
    return quaternion.of_euler(Vec3.of(jnp.asarray(DRAWN)))


@pytest.fixture(autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def test_there_and_back():
    attitude = frames.attitude(drawn())
    vector = np.random.default_rng(1).normal(size=(500, 3))
    world = frames.body_to_world(attitude, Vec3.of(jnp.asarray(vector)))
    np.testing.assert_allclose(array(world), ref.rotate(ref.rotation(DRAWN), vector), atol=1e-14)
    np.testing.assert_allclose(array(frames.world_to_body(attitude, world)), vector, atol=1e-14)
    np.testing.assert_allclose(array(quaternion.to_euler(drawn(), arctan2)), DRAWN, atol=1e-7)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_derivative_turns_about_the_body_axis(axis):
    """After h s at 1 rad/s about a body axis, the rotation is R times a rotation by h."""
    h, rates = 1e-4, Vec3.of(jnp.eye(3)[axis])
    slope = frames.euler_rates(frames.attitude(drawn()), rates)
    turned = jax.tree.map(lambda q, dq: q + h * dq, drawn(), slope)
    found = frames.attitude(quaternion.normalized(turned)).matrix
    rows = np.stack([array(row) for row in found.rows()], axis=-2)
    turn = ref.elementary(axis, np.full(1, h))
    np.testing.assert_allclose(rows, ref.rotation(DRAWN) @ turn, atol=1e-11)


def test_arctangent_in_single_precision():
    y, x = np.random.default_rng(2).normal(size=(2, 4000)).astype(np.float32)
    y[:4], x[:4] = [0, 1, -1, 0], [-1, 0, 0, 0]
    found = arctan2(jnp.asarray(y), jnp.asarray(x))
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, np.arctan2(y.astype(float), x.astype(float)), atol=5e-7)


def test_derivatives_of_the_angles():
    """Of angles from a quaternion of angles: the identity."""
    slope = jax.vmap(
        jax.jacfwd(lambda euler: quaternion.to_euler(quaternion.of_euler(euler), arctan2))
    )(Vec3.of(jnp.asarray(DRAWN * [1.0, 0.98, 1.0])))
    found = np.stack([array(row) for row in slope.components()], axis=-2)
    np.testing.assert_allclose(found, np.broadcast_to(np.eye(3), found.shape), atol=1e-6)


@pytest.mark.parametrize("euler", [(0.4, np.pi / 2, 0.3), (0.0, -np.pi / 2, 0.0), (np.pi, 0, 0)])
def test_derivatives_of_the_angles_are_bounded(euler):
    q = quaternion.of_euler(Vec3.of(jnp.asarray(euler)))
    slope = jax.jacrev(lambda q: quaternion.to_euler(q, arctan2))(q)
    assert all(np.all(np.abs(leaf) <= 200) for leaf in jax.tree.leaves(slope))
