"""Operations on gradients, by their definitions."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.gradients import clip_inward, scale_and_clip_cotangent


def test_clip_inward_lets_descent_come_back():
    """On the bound itself nothing is clipped; outside, descent passes inwards only."""
    values = jnp.array([0.0, 0.0, 1.0, 1.0, -1.0, 1.5, 1.5, -1.5, -1.5])
    cotangents = jnp.array([1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, -1.0, 1.0])
    passes = np.array([1, 1, 1, 1, 1, 1, 0, 1, 0])
    bounds = (jnp.float32(-1.0), jnp.float32(1.0))
    clipped, back = jax.vjp(jax.vmap(clip_inward, in_axes=(0, None, None)), values, *bounds)
    np.testing.assert_array_equal(clipped, np.clip(values, -1, 1))
    slope, low, high = back(cotangents)
    np.testing.assert_array_equal(slope, cotangents * passes)
    assert low == high == 0.0


def test_cotangents_are_scaled_clipped_and_finite():
    tree = {"x": jnp.zeros(6), "n": jnp.arange(3), "on": jnp.array(True)}
    weights = jnp.array([0.1, -0.1, 10.0, -10.0, jnp.nan, jnp.inf])

    def total(x):
        same = scale_and_clip_cotangent({**tree, "x": x}, jnp.float32(0.5), jnp.float32(2.0))
        return jnp.sum(weights * same["x"])

    slope = jax.jit(jax.grad(total))(tree["x"])
    np.testing.assert_allclose(slope, [0.05, -0.05, 2.0, -2.0, 0.0, 0.0], rtol=1e-6)
    odd = {**tree, "x": jnp.array([1.0, jnp.nan, jnp.inf])}
    same = jax.jit(scale_and_clip_cotangent)(odd, jnp.float32(0.5), jnp.float32(0.1))
    chex.assert_trees_all_equal(same, odd)


def test_cotangents_are_scaled_at_every_step_of_a_scan():
    def rolled(x):
        def step(x, _):
            return 2.0 * scale_and_clip_cotangent(x, jnp.float32(0.25), jnp.float32(1e3)), None

        return jax.lax.scan(step, x, None, 5)[0]

    assert jax.grad(rolled)(jnp.float32(1.0)) == pytest.approx(0.5**5)
    assert rolled(jnp.float32(1.0)) == 32
