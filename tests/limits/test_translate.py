"""The equations that the solver uses are those of the vehicle models."""

import jax
import numpy as np
import pytest

from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.limits.problem import (
    ATTITUDE,
    RATES,
    VELOCITY,
    double,
    make_problem,
    numbers,
    to_euler,
)

casadi = pytest.importorskip("casadi")
from quadjax.limits.collocation import Dynamics  # noqa: E402
from quadjax.limits.translate import translate  # noqa: E402

RACES = {
    "motor": ("e2e",),
    "motor with residual": ("e2e +residual",),
    "rate": ("indi +fastest",),
    "5-inch": ("e2e +fastest", "vehicle=5inch"),
    "A2RL": ("e2e +fastest", "vehicle=a2rl"),
}


def _race(name):
    return make_race(load_config(RACES[name][0], list(RACES[name][1:])))


@pytest.mark.parametrize("name", RACES)
def test_the_equations_agree_with_jax(name):
    environment, params = _race(name)
    problem, rng = make_problem(environment, params), np.random.default_rng(0)
    slope, (low, high) = Dynamics(problem).slope, problem.command_range
    for _ in range(5):
        start = problem.start
        state = start * rng.uniform(0.5, 1.5, len(start)) + rng.uniform(-0.5, 0.5, len(start))
        state[ATTITUDE] /= np.linalg.norm(state[ATTITUDE])
        command = rng.uniform(low, high)
        with jax.enable_x64(True):
            expected = np.asarray(problem.slope(state, command))
        found = np.array(slope(state, command)).ravel()
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * abs(expected).max())


@pytest.mark.parametrize("name", ["motor", "rate"])
def test_a_quaternion_has_the_accelerations_of_the_race_with_euler_angles(name):
    environment, params = _race(name)
    problem, model, vehicle = (
        make_problem(environment, params),
        environment.model,
        double(params.vehicle),
    )
    vector = problem.start + 0.1 * np.random.default_rng(0).normal(size=len(problem.start))
    vector[ATTITUDE] /= np.linalg.norm(vector[ATTITUDE])
    command = 0.7 * problem.command_range[1]
    with jax.enable_x64(True):
        found = np.asarray(problem.slope(vector, command))
        state = problem.state(vector)
        (roll, pitch, yaw), vec = to_euler(vector[None])[0], type(state.position)
        low, _ = model.command_range(vehicle.constants)
        held = jax.tree.structure(low).unflatten(list(command))
        slope = model.derivative(vehicle, state.replace(attitude=vec(roll, pitch, yaw)), held)
    np.testing.assert_allclose(found[VELOCITY], numbers(slope.velocity), rtol=1e-6)
    np.testing.assert_allclose(found[RATES], numbers(slope.rates), rtol=1e-9)


def test_an_unknown_operation_is_named():
    function = translate(jax.lax.erf_inv, np.array([0.5]))
    with pytest.raises(InputError, match="erf_inv"):
        function(casadi.SX.sym("x"))
