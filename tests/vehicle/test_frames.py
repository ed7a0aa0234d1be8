"""Functions of angles and vectors; rotations are tested by the models against the reference."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core import frames
from quadjax.core.vectors import safe_norm
from tests.convert import vec3


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


def test_safe_norm():
    both = jax.jit(jax.vmap(jax.value_and_grad(safe_norm)))
    length, slope = both(vec3(np.float32([[3, 0, -4], [0, 0, 0]])))
    assert length[0] == 5
    np.testing.assert_array_equal([x[1] for x in slope], [0, 0, 0])
    np.testing.assert_allclose([x[0] for x in slope], [0.6, 0, -0.8], rtol=1e-6)
