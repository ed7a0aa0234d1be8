import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.integrators import INTEGRATORS, euler_step, rk4_loop_step, rk4_step
from quadjax.vehicle import motor
from quadjax.vehicle.protocol import VehicleParams
from tests import reference as ref
from tests.convert import command_of, constants, rows_of, state_of
from tests.promotion import QUICK

TIME = 0.32


@pytest.fixture(scope="module", autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


@functools.partial(jax.jit, static_argnames="name", compiler_options=QUICK)
def fly(name, params, state, command, time, steps):
    """The state after any number of steps, by one program for each integrator."""
    slope = functools.partial(motor.MODEL.derivative, params, command=command)
    return jax.lax.fori_loop(
        0, steps, lambda _, state: INTEGRATORS[name](slope, state, time / steps), state
    )


@pytest.fixture(scope="module")
def start():
    rows = ref.random_states("motor", 1, seed=5)[0]
    rows[ref.EULER], rows[ref.RATES] = [0.2, -0.3, 1.0], [1.0, -0.5, 0.3]
    rows[ref.V], rows[ref.RPM] = [1.0, -0.5, 0.2], [7000, 7200, 7100, 6900]
    rows[ref.MOMENT] = 0.0
    return state_of("motor", rows), command_of("motor", np.array([7600.0, 7400, 7500, 7700]))


def test_one_step_of_each():
    """On x' = -x: Euler keeps one term of the series, Runge-Kutta five."""
    state = {"x": jnp.asarray(2.0)}
    slope = functools.partial(jax.tree.map, jnp.negative)
    assert float(euler_step(slope, state, 0.1)["x"]) == pytest.approx(1.8, rel=1e-14)
    series = 2 * (1 - 0.1 + 0.1**2 / 2 - 0.1**3 / 6 + 0.1**4 / 24)
    assert float(rk4_step(slope, state, 0.1)["x"]) == pytest.approx(series, rel=1e-14)
    assert float(rk4_loop_step(jnp.negative, state["x"], 0.1)) == pytest.approx(series, rel=1e-14)


@pytest.mark.parametrize(("name", "order"), [("euler", 1), ("rk4", 4)])
def test_order_of_convergence(start, name, order):
    params = VehicleParams(constants("motor", ref.MOTOR))
    exact = rows_of(fly("rk4", params, *start, TIME, 1024))
    errors = [
        np.abs(rows_of(fly(name, params, *start, TIME, steps)) - exact)[:12].max()
        for steps in (32, 64, 128)
    ]
    measured = np.log2(np.divide(errors[:-1], errors[1:]))
    assert np.all(np.abs(measured - order) < 0.25), measured


def test_torque_free_tumbling_keeps_its_angular_momentum(start):
    names = ("k_p", "k_q", "k_pv", "k_qv", "k_r1", "k_r2", "k_rr")
    params = VehicleParams(constants("motor", ref.MOTOR | dict.fromkeys(names, 0.0)))
    rates = jax.tree.map(lambda x: 4 * x, start[0].rates)
    state = start[0].replace(rates=rates)  # without an external moment
    inertia = np.array([0.000906, 0.001242, 0.002054])

    def momentum(state):
        rows = rows_of(state)
        return ref.rotation(rows[ref.EULER]) @ (inertia * rows[ref.RATES])

    tumbled = fly("rk4", params, state, start[1], TIME, 256)
    np.testing.assert_allclose(momentum(tumbled), momentum(state), rtol=1e-7)
    assert np.abs(rows_of(tumbled)[ref.RATES] - rows_of(state)[ref.RATES]).max() > 0.1
