"""Operations on gradients, by their definitions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.gradients import clip_inward, scale_and_clip_cotangent


@pytest.mark.parametrize(
    ("value", "cotangent", "passes"),
    [
        (0.0, 1.0, True),
        (0.0, -1.0, True),
        (1.0, 1.0, True),
        (1.0, -1.0, True),  # on the bound itself nothing is clipped yet
        (-1.0, 1.0, True),
        (1.5, 1.0, True),  # descent moves it down: inwards
        (1.5, -1.0, False),
        (-1.5, -1.0, True),  # descent moves it up: inwards
        (-1.5, 1.0, False),
    ],
)
def test_clip_inward_lets_descent_come_back(value, cotangent, passes):
    clipped, back = jax.vjp(lambda x: clip_inward(x, -1.0, 1.0), jnp.float32(value))
    assert clipped == np.clip(value, -1, 1)
    assert back(jnp.float32(cotangent))[0] == (cotangent if passes else 0.0)


def test_clip_inward_of_traced_bounds_gives_them_no_gradient():
    bounds = (jnp.float32(-1.0), jnp.float32(2.0))
    slopes = jax.grad(lambda x, low, high: 3.0 * clip_inward(x, low, high), (0, 1, 2))(
        jnp.float32(5.0), *bounds
    )
    assert slopes == (3.0, 0.0, 0.0)


def test_scale_and_clip_is_the_identity_forwards():
    tree = {"x": jnp.array([1.0, jnp.nan, jnp.inf]), "n": jnp.arange(3), "on": jnp.array(True)}
    kept = jax.jit(scale_and_clip_cotangent)(tree, jnp.float32(0.5), jnp.float32(0.1))
    jax.tree.map(np.testing.assert_array_equal, kept, tree)


def test_cotangents_are_scaled_clipped_and_finite():
    tree = {"x": jnp.zeros(6), "n": jnp.arange(3)}
    weights = jnp.array([0.1, -0.1, 10.0, -10.0, jnp.nan, jnp.inf])

    def total(x):
        kept = scale_and_clip_cotangent({**tree, "x": x}, jnp.float32(0.5), jnp.float32(2.0))
        return jnp.sum(weights * kept["x"])

    slope = jax.jit(jax.grad(total))(tree["x"])
    np.testing.assert_allclose(slope, [0.05, -0.05, 2.0, -2.0, 0.0, 0.0], rtol=1e-6)


def test_cotangents_are_scaled_at_every_step_of_a_scan():
    def rolled(x):
        def step(x, _):
            return 2.0 * scale_and_clip_cotangent(x, jnp.float32(0.25), jnp.float32(1e3)), None

        return jax.lax.scan(step, x, None, 5)[0]

    assert jax.grad(rolled)(jnp.float32(1.0)) == pytest.approx(0.5**5)
    assert rolled(jnp.float32(1.0)) == 32
