"""Gradients through short flights against central differences, in double precision."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from quadjax.race.types import RaceState
from tests import reference as ref
from tests.convert import residual_of, state_of
from tests.promotion import QUICK
from tests.race.support import make_race, track_of
from tests.race.test_flight import double

STEPS = 12
WEIGHTS = {  # of flights whose returns are differentiated
    "progress": {"progress": 1.0},
    "edge": {"gate_edge": 5.0, "gate_offset": 10.0},
    "flat": {"gate": 10.0, "time": 1.0, "collision": 2.0},  # constant while the same things happen
    "all": {"progress": 1.0, "gate": 10, "gate_offset": 10, "collision": 10, "time": 1}
    | {"body_rates": 0.05, "pitch_up": 1.0, "next_gate_progress": 1.0, "gate_edge": 5.0},
}


@pytest.fixture(scope="module", autouse=True)
def _double():
    with jax.enable_x64(True):
        yield


def approach(kind):
    """On the way to the first gate, off its center, passing it halfway through the flight."""
    rows = np.zeros((1, 22 if kind == "motor" else 13))
    ahead = np.array([np.cos(ref.GATE_YAW[0]), np.sin(ref.GATE_YAW[0]), 0])
    rows[:, ref.P] = ref.GATES[0] - 0.33 * ahead + [0.1, -0.15, 0.2]
    rows[:, ref.V] = 5 * ahead + [0.3, -0.2, 0.4]
    rows[:, ref.EULER], rows[:, ref.RATES] = [0.3, -0.4, 0.6], [0.8, -1.1, 0.6]
    if kind == "motor":
        rows[:, ref.RPM] = [7000, 7500, 6500, 7200]
        rows[:, ref.MOMENT], rows[:, ref.FORCE] = [0.003, -0.002, 0.001], [0.0, 0.0, 0.3]
    else:
        rows[:, 12] = 9.0
    return jax.tree.map(lambda x: np.asarray(x)[0], state_of(kind, rows))


@functools.cache
def flights(kind):
    """Returns of flights with their gradients, by one program."""
    environment, params = make_race(f"vehicle.model={kind}")
    params = double(params.replace(track=track_of(ref.GATES[:2], ref.GATE_YAW[:2])))
    if kind == "motor":
        net = residual_of(ref.random_residual(1.0))
        params = params.replace(vehicle=params.vehicle.replace(residual=net))
    actions = np.random.default_rng(4).uniform(-0.4, 0.4, (STEPS, 4))
    drone = approach(kind)
    flat, unravel = ravel_pytree((drone, actions))
    steps = jax.tree.map(lambda x: 1e3 if abs(x) > 1000 else 0.1, drone)
    size = np.append(jax.tree.leaves(steps), np.full(STEPS * 4, 0.3))

    def outcome(moves, weights):
        drone, actions = unravel(flat + size * moves)
        zero, race = np.zeros((), np.int32), params.replace(reward=weights)

        def step(state, action):
            state, value, outcome = environment.transition(race, state, action)
            return state, (value, outcome.passed, outcome.crashed)

        state = RaceState(drone, zero, zero, zero, None)
        _, (values, passed, ended) = jax.lax.scan(step, state, actions)
        return jnp.sum(values), (passed, ended)

    both = jax.vmap(jax.value_and_grad(outcome, has_aux=True), in_axes=(0, None))
    return jax.jit(both, compiler_options=QUICK), flat.size, params.reward


@pytest.mark.parametrize("kind", ["motor", "rate"])
@pytest.mark.parametrize("case", WEIGHTS)
def test_gradient_of_the_return(kind, case):
    both, size, reward = flights(kind)
    weight = dict.fromkeys(WEIGHTS["all"], 0.0) | WEIGHTS[case]
    weight |= {"gate_edge_margin": 0.45}  # so that the flight passes beyond the safe part
    weights = reward.replace(**{name: np.float64(value) for name, value in weight.items()})
    h = 1e-4
    moves = np.concatenate([np.zeros((1, size)), h * np.eye(size), -h * np.eye(size)])
    (value, (passed, ended)), slope = jax.tree.map(np.asarray, both(moves, weights))
    assert np.sum(passed[0]) == 1 and not np.any(ended) and 3 < np.argmax(passed[0]) < STEPS - 1
    slope, measured = slope[0], (value[1 : size + 1] - value[size + 1 :]) / (2 * h)
    largest = np.abs(measured).max()
    assert (largest < 1e-9) == (case == "flat")
    np.testing.assert_allclose(slope, measured, atol=max(2e-6 * largest, 1e-9))


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_saturated_actions_can_come_back(kind):
    """Beyond the limit the gradient is the one at the limit, or nothing, by its direction."""
    environment, params = make_race(f"vehicle.model={kind}")
    params, zero = double(params), np.zeros((), np.int32)
    state = RaceState(approach(kind), zero, zero, zero, None)

    def speed(action, sign):
        following, _, _ = environment.transition(params, state, action)
        return sign * jax.tree.leaves(following.drone.actuators)[0]

    slope = jax.jit(jax.grad(speed), compiler_options=QUICK)
    found = [
        float(slope(np.full(4, action), sign)[0 if kind == "motor" else 3])
        for action, sign in ((0.0, 1.0), (1.7, 1.0), (1.7, -1.0), (-1.7, -1.0), (-1.7, 1.0))
    ]
    inside = found[0]
    assert inside > 0 and found == pytest.approx([inside, inside, 0.0, -inside, 0.0])


def test_gradient_is_finite_where_a_flight_ends():
    """At the gate's very center, with no rates, in a crash and at the last step."""
    environment, params = make_race("reward.body_rates=0.1")
    params, zero = double(params), np.zeros((), np.int32)
    base = approach("motor")
    still = jax.tree.map(np.zeros_like, base.rates)
    at_gate = jax.tree.map(lambda x: x[0], params.track.position)
    below = base.position.replace(z=np.float64(-0.001))

    def value(drone, action):
        state = RaceState(drone, zero, np.int32(1199), zero, None)
        return environment.transition(params, state, action)[1]

    slope = jax.jit(jax.grad(value, (0, 1)), compiler_options=QUICK)
    for drone in (
        base.replace(position=at_gate, velocity=still, rates=still, attitude=still),
        base.replace(position=below, velocity=base.velocity.replace(z=np.float64(3.0))),
    ):
        assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope(drone, np.zeros(4))))
