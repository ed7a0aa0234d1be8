"""The equations that the solver uses are those of the vehicle models."""

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.config.race import race_of
from quadjax.core.vectors import Rotors
from quadjax.limits.jaxpr import translate
from quadjax.limits.problem import leaves, make_problem
from quadjax.vehicle.racing import motor_map

casadi = pytest.importorskip("casadi")
RACES = {
    "motor": ("e2e_shac",),
    "motor with residual": ("e2e",),
    "rate": ("indi",),
    "5-inch": ("e2e_fastest", "vehicle=5inch"),
    "A2RL": ("e2e_fastest", "vehicle=a2rl"),
    "CPC": ("e2e_fastest", "vehicle=cpc"),
}


def _problem(name, **options):
    choices, params = race_of(load_config(RACES[name][0], list(RACES[name][1:])))
    return make_problem(choices.model, params, **options)


@pytest.mark.parametrize("name", RACES)
def test_the_equations_agree_with_jax(name):
    from quadjax.limits.collocation import Dynamics

    problem = _problem(name)
    model, rng = problem.model, np.random.default_rng(0)
    slope = Dynamics(problem).slope
    low, high = problem.command_range
    for _ in range(5):
        start = leaves(problem.hover_state)
        state = start * rng.uniform(0.5, 1.5, len(start)) + rng.uniform(-1.0, 1.0, len(start))
        with jax.enable_x64(True):
            unit = leaves(model.wrap(problem.state(map(np.float64, state))))
        state = np.where(problem.normalized, unit, state)  # angles as they are
        command = rng.uniform(low, high)
        with jax.enable_x64(True):
            held = model.hold(problem.state(map(np.float64, state)), problem.command(command))
            expected = leaves(model.derivative(problem.vehicle, held, problem.command(command)))
        found = np.array(slope(state, command)).ravel()
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * abs(expected).max())


def test_the_specific_force_is_in_double_precision_after_a_simulation_in_single():
    choices, params = race_of(load_config("e2e_race", ["vehicle=5inch"]))
    jax.eval_shape(lambda c: motor_map(c, Rotors(*(c.k,) * 4)), params.vehicle.constants)
    problem = make_problem(choices.model, params)
    speeds = np.array([1000.0, 1500.0, 2000.0, 2500.0])
    state = problem.hover_at(*np.zeros((3, 3)))
    state[problem.actuator_leaves] = speeds
    expected = [0.0, 0.0, -np.float64(np.float32(2.49e-06)) * np.sum(speeds**2)]
    np.testing.assert_allclose(problem.specific_force(state), expected, rtol=1e-12, atol=1e-12)


def test_an_unknown_operation_is_named():
    from quadjax.core.errors import InputError
    from quadjax.limits.extra import OPERATIONS

    function = translate(jax.lax.erf_inv, OPERATIONS, 0.5)
    with pytest.raises(InputError, match="erf_inv"):
        function(casadi.SX.sym("x"))


def test_the_components_of_the_attitude():
    euler, quaternion = _problem("rate"), _problem("CPC")
    assert euler.angles.sum() in (2, 3) and not euler.normalized.any()
    assert not quaternion.angles.any() and quaternion.normalized.sum() == 4
