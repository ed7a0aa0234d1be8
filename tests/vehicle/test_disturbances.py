"""External moments and forces of every model that can have them, and their onboard estimate."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import quadjax
from quadjax.config.assembly import make_race
from quadjax.core.vectors import Vec3
from quadjax.race.memory import DISTURBANCE
from quadjax.vehicle.registry import MODELS

DISTURBED = [name for name, model in MODELS.items() if model.can_be_disturbed]
VEHICLES = {"motor": "bebop1", "racing": "5inch", "a2rl": "a2rl"}
MOMENTS = {"motor": 0.01, "racing": 20.0, "a2rl": 20.0}


@functools.cache
def race(name):
    """A race with disturbances and their estimate, and a state at a start."""
    base = "e2e" if name == "motor" else "e2e_race"
    words = [f"disturbance.moment_{axis}={MOMENTS[name]}" for axis in "xyz"]
    words += ["disturbance.force_z=2", "observation.disturbance=estimated"]
    config = quadjax.load(base, [f"vehicle={VEHICLES[name]}", "vehicle.integrator=euler", *words])
    environment, params = make_race(config)
    state = jax.jit(environment.reset)(params, jax.random.key(3))
    return environment, params, state


@pytest.mark.parametrize("name", DISTURBED)
def test_moment_and_force_reach_the_derivative(name):
    environment, params, state = race(name)
    model, drone = environment.model, state.drone
    moment, force = drone.disturbance
    assert abs(moment.x) > 0 and abs(force.z) > 0 and force.x == 0
    command = model.command_range(params.vehicle.constants)[1]
    slope = jax.jit(model.derivative)
    calm = drone.replace(moment_ext=Vec3.zero(), force_ext=Vec3.zero())
    with_it, without = (slope(params.vehicle, x, command) for x in (drone, calm))
    change = drone.to_body(with_it.velocity - without.velocity)
    np.testing.assert_allclose(change.array(), force.array(), atol=1e-4)
    turn = (with_it.rates - without.rates).array()
    c = params.vehicle.constants
    inertia = jnp.array([c.i_xx, c.i_yy, c.i_zz]) if model.moment_unit == "N m" else 1.0
    np.testing.assert_allclose(turn * inertia, moment.array(), rtol=1e-3)


@pytest.mark.parametrize("name", DISTURBED)
def test_the_estimate_settles_at_the_disturbance(name):
    environment, params, first = race(name)
    assert "moment_ext" in environment.layout.names
    key = jax.random.key(3)
    actions = 0.1 * jax.random.normal(key, (60, environment.model.action_size)) - 0.3

    @jax.jit
    def flown(params, first, actions):
        def step(state, action):
            following = environment.step(params, state, action)[0]
            return following, following.memories[DISTURBANCE]

        return jax.lax.scan(step, first, actions)[1]

    estimate = flown(params, first, actions)
    moment, force = first.drone.disturbance
    late = jax.tree.map(lambda x: np.asarray(x)[-1], (estimate.moment, estimate.force))
    np.testing.assert_allclose(late[0].array(), moment.array(), atol=0.02 * MOMENTS[name])
    np.testing.assert_allclose(late[1].array(), force.array(), atol=0.1)


def test_a_race_without_disturbances_has_no_such_state():
    environment, params = make_race(quadjax.load("e2e_race", ["vehicle=5inch"]))
    assert not environment.model.disturbed and "moment_ext" not in environment.layout.names
