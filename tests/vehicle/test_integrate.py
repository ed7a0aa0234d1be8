"""Angles, vectors and steps of integration; the models test rotations against the reference."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core import frames
from quadjax.core.integrators import INTEGRATORS, euler_step, rk4_loop_step, rk4_step
from quadjax.core.vectors import safe_norm
from quadjax.vehicle import motor
from quadjax.vehicle.protocol import VehicleParams
from tests import reference as ref
from tests.convert import command_of, constants, rows_of, state_of, vec3
from tests.promotion import QUICK

TIME = 0.32


@pytest.fixture
def double():
    with jax.enable_x64(True):
        yield


@functools.partial(jax.jit, static_argnames="name", compiler_options=QUICK)
def fly(name, params, state, command, time, steps):
    """The state after any number of steps, by one program for each integrator."""
    slope = functools.partial(motor.MODEL.derivative, params, command=command)
    return jax.lax.fori_loop(
        0, steps, lambda _, state: INTEGRATORS[name](slope, state, time / steps), state
    )


def begin():
    rows = ref.random_states("motor", 1, seed=5)[0]
    rows[ref.EULER], rows[ref.RATES] = [0.2, -0.3, 1.0], [1.0, -0.5, 0.3]
    rows[ref.V], rows[ref.RPM] = [1.0, -0.5, 0.2], [7000, 7200, 7100, 6900]
    rows[ref.MOMENT] = 0.0
    return state_of("motor", rows), command_of("motor", np.array([7600.0, 7400, 7500, 7700]))


@pytest.mark.usefixtures("double")
def test_one_step_of_each():
    """On x' = -x: Euler keeps one term of the series, Runge-Kutta five."""
    state = {"x": jnp.asarray(2.0)}
    slope = functools.partial(jax.tree.map, jnp.negative)
    assert float(euler_step(slope, state, 0.1)["x"]) == pytest.approx(1.8, rel=1e-14)
    series = 2 * (1 - 0.1 + 0.1**2 / 2 - 0.1**3 / 6 + 0.1**4 / 24)
    assert float(rk4_step(slope, state, 0.1)["x"]) == pytest.approx(series, rel=1e-14)
    assert float(rk4_loop_step(jnp.negative, state["x"], 0.1)) == pytest.approx(series, rel=1e-14)


@pytest.mark.parametrize(("name", "order"), [("euler", 1), ("rk4", 4)])
@pytest.mark.usefixtures("double")
def test_order_of_convergence(name, order):
    params, start = VehicleParams(constants("motor", ref.MOTOR)), begin()
    exact = rows_of(fly("rk4", params, *start, TIME, 1024))
    errors = [
        np.abs(rows_of(fly(name, params, *start, TIME, steps)) - exact)[:12].max()
        for steps in (32, 64, 128)
    ]
    measured = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(np.abs(measured - order) < 0.25), measured


@pytest.mark.usefixtures("double")
def test_free_fall_keeps_its_energy():
    off = dict.fromkeys(("k_x", "k_y", "k_z", "k_w", "k_h"), 0.0)
    params, (state, command) = VehicleParams(constants("motor", ref.MOTOR | off)), begin()
    state = state.replace(force_ext=jax.tree.map(jnp.zeros_like, state.force_ext))

    def energy(state):
        rows = rows_of(state)
        return 0.5 * np.sum(rows[ref.V] ** 2) - ref.MOTOR["g"] * rows[2]

    fallen = fly("rk4", params, state, command, TIME, 64)
    assert energy(fallen) == pytest.approx(energy(state), rel=1e-12)
    np.testing.assert_allclose(rows_of(fallen)[5], rows_of(state)[5] + 9.81 * TIME, rtol=1e-12)


@pytest.mark.usefixtures("double")
def test_torque_free_tumbling_keeps_its_angular_momentum():
    """Through a roll of 180 deg."""
    names = ("k_p", "k_q", "k_pv", "k_qv", "k_r1", "k_r2", "k_rr")
    params = VehicleParams(constants("motor", ref.MOTOR | dict.fromkeys(names, 0.0)))
    state, command = begin()
    zero = jax.tree.map(jnp.zeros_like, state.moment_ext)
    rates = vec3(np.array([12.0, -2.0, 1.2]))
    state = state.replace(moment_ext=zero, rates=rates)
    inertia = np.array([ref.MOTOR[name] for name in ("i_xx", "i_yy", "i_zz")])

    def momentum(state):
        rows = rows_of(state)
        return ref.rotation(rows[ref.EULER]) @ (inertia * rows[ref.RATES])

    tumbled = fly("rk4", params, state, command, TIME, 256)
    np.testing.assert_allclose(momentum(tumbled), momentum(state), rtol=1e-6)
    assert np.abs(rows_of(tumbled)[ref.RATES] - rows_of(state)[ref.RATES]).max() > 0.1
    assert rows_of(tumbled)[ref.EULER][0] > np.pi


def test_the_references_rotations():
    """By hand, orthogonal, and ``R' = R [Omega]x`` with the derivative taken numerically."""
    east, up, right = ref.rotation(0.5 * np.pi * np.eye(3)[::-1])  # about z, y and x
    np.testing.assert_allclose(east @ [1, 0, 0], [0, 1, 0], atol=1e-15)  # the nose
    np.testing.assert_allclose(up @ [1, 0, 0], [0, 0, -1], atol=1e-15)  # the nose
    np.testing.assert_allclose(right @ [0, 1, 0], [0, 0, 1], atol=1e-15)  # that wing down
    random = np.random.default_rng(3)
    euler, rates, h = random.uniform(-1.4, 1.4, (50, 3)), random.uniform(-10, 10, (50, 3)), 1e-6
    matrix, turn = ref.rotation(euler), h * ref.euler_rates(euler, rates)
    np.testing.assert_allclose(matrix @ np.swapaxes(matrix, 1, 2), [np.eye(3)] * 50, atol=1e-14)
    slope = (ref.rotation(euler + turn) - ref.rotation(euler - turn)) / (2 * h)
    spin = np.cross(rates[:, None], np.eye(3)).swapaxes(1, 2)  # columns Omega x e
    np.testing.assert_allclose(slope, matrix @ spin, atol=1e-6)


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
