import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core import frames
from quadjax.core.vectors import Vec3, safe_norm
from tests import reference as ref
from tests.convert import vec3


@pytest.fixture(scope="module")
def draw():
    return np.random.default_rng(3)


@pytest.fixture(scope="module")
def euler():
    return ref.random_states("motor", 3000)[:, ref.EULER]


def test_sincos_stays_within_1e_7_over_20_rad():
    angle = np.linspace(-20, 20, 400_001).astype(np.float32)
    sine, cosine = jax.jit(frames.sincos)(angle)
    assert np.max(np.abs(np.asarray(sine, float) - np.sin(angle.astype(float)))) < 1e-7
    assert np.max(np.abs(np.asarray(cosine, float) - np.cos(angle.astype(float)))) < 1e-7


@pytest.mark.parametrize("wide", [False, True])
def test_sincos_derivative(wide):
    angle = np.linspace(-20, 20, 1001)
    with jax.enable_x64(wide):
        x = jnp.asarray(angle, jnp.float64 if wide else jnp.float32)
        slopes = [jax.grad(lambda a, i=i: frames.sincos(a)[i]) for i in (0, 1)]
        d_sine, d_cosine = jax.jit(jax.vmap(lambda a: [slope(a) for slope in slopes]))(x)
        assert d_sine.dtype == x.dtype
    tolerance = 1e-12 if wide else 1e-6
    np.testing.assert_allclose(d_sine, np.cos(np.asarray(x, float)), atol=tolerance)
    np.testing.assert_allclose(d_cosine, -np.sin(np.asarray(x, float)), atol=tolerance)


def test_wrap_angle():
    angle = np.linspace(-30, 30, 2001).astype(np.float32)
    wrapped, gradient = jax.jit(jax.vmap(jax.value_and_grad(frames.wrap_angle)))(angle)
    wrapped = np.asarray(wrapped, float)
    assert np.max(np.abs(wrapped)) <= np.pi + 1e-5
    turns = (angle - wrapped) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-5)
    np.testing.assert_array_equal(gradient, 1.0)


def rotation_matrix(euler):
    """Body to world (3, 3): the images of the body's axes."""
    turned = [frames.body_to_world(frames.attitude(euler), Vec3.of(axis)) for axis in jnp.eye(3)]
    return jnp.stack([image.array() for image in turned], axis=-1)


def test_rotation_matrix_is_the_product_of_yaw_pitch_and_roll(euler):
    with jax.enable_x64(True):
        found = np.asarray(jax.jit(jax.vmap(rotation_matrix))(vec3(euler)))
    np.testing.assert_allclose(found, ref.rotation(euler), atol=1e-13)
    assert np.max(np.abs(found @ np.swapaxes(found, 1, 2) - np.eye(3))) < 1e-13
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-13)


def test_rotation_by_hand():
    quarter = 0.5 * np.eye(3, dtype=np.float32)[::-1] * np.float32(np.pi)  # about z, y and x
    east, up, right = np.asarray(jax.jit(jax.vmap(rotation_matrix))(vec3(quarter)))
    np.testing.assert_allclose(east @ [1.0, 0, 0], [0, 1, 0], atol=1e-6)  # the nose
    np.testing.assert_allclose(up @ [1.0, 0, 0], [0, 0, -1], atol=1e-6)  # the nose
    np.testing.assert_allclose(right @ [0, 1.0, 0], [0, 0, 1], atol=1e-6)  # that wing down


def test_body_and_world_are_inverse(euler, draw):
    vector = draw.normal(size=euler.shape)
    with jax.enable_x64(True):
        a = jax.jit(frames.attitude)(vec3(euler))
        world = jax.jit(frames.body_to_world)(a, vec3(vector))
        np.testing.assert_allclose(
            world.array(), ref.rotate(ref.rotation(euler), vector), atol=1e-12
        )
        np.testing.assert_allclose(
            jax.jit(frames.world_to_body)(a, world).array(), vector, atol=1e-12
        )


def test_euler_rates_turn_the_rotation_matrix_as_the_body_rates_do(euler, draw):
    """``R' = R [Omega]x``, with the derivative of R taken numerically."""
    rates = draw.uniform(-10, 10, euler.shape)
    with jax.enable_x64(True):
        turn = jax.jit(lambda e, r: frames.euler_rates(frames.attitude(e), r).array())
        found = np.asarray(turn(vec3(euler), vec3(rates)))
    np.testing.assert_allclose(found, ref.euler_rates(euler, rates), rtol=1e-9, atol=1e-9)
    h = 1e-6
    slope = (ref.rotation(euler + h * found) - ref.rotation(euler - h * found)) / (2 * h)
    spin = np.zeros((len(rates), 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        spin[:, k, j], spin[:, j, k] = rates[:, i], -rates[:, i]
    scale = 1 + np.abs(found).max(axis=1)[:, None, None] ** 2
    assert np.max(np.abs(slope - ref.rotation(euler) @ spin) / scale) < 1e-7


def test_safe_norm():
    both = jax.jit(jax.vmap(jax.value_and_grad(safe_norm)))
    length, slope = both(vec3(np.float32([[3, 0, -4], [0, 0, 0]])))
    assert length[0] == 5
    np.testing.assert_array_equal([x[1] for x in slope], [0, 0, 0])
    np.testing.assert_allclose([x[0] for x in slope], [0.6, 0, -0.8], rtol=1e-6)
