"""The race of drones whose attitude is a quaternion: any attitude, its observation and gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.vectors import Vec3
from quadjax.race import environment
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.protocol import Motion
from tests import reference as ref
from tests.promotion import QUICK
from tests.race.support import (
    compiled_observe,
    compiled_reset,
    compiled_transition,
    make_race,
    race_state,
    track_of,
)

TRACK = "track=figure8_tudelft"
# Roll, pitch, yaw: level, nose up, nose down, inverted, and inverted by pitching through 90 deg.
ATTITUDES = np.array(
    [[0.1, 0.2, 0.3], [0, np.pi / 2, 0], [0.5, -np.pi / 2, 2], [np.pi, 0, 0], [0, 2.5, 0]]
)


def states(race, attitudes):
    """Drones in hover 1 m before the first gate, but for their attitudes and a forward speed."""
    choices, params = race
    gate = np.array([float(x[0]) for x in params.track.position])
    still = [np.zeros(3, np.float32)] * 4
    still[0], still[1] = np.float32(gate - [0, 1, 0]), np.float32([0, 3, 0])

    def one(constants, euler):
        motion = Motion(*(Vec3.of(x) for x in (still[0], still[1], euler, still[3])))
        drone = choices.model.hover(constants, motion)
        zero = jnp.zeros((), jnp.int32)
        return environment.RaceState(drone, zero, zero, zero, None)

    hover = jax.jit(jax.vmap(one, in_axes=(None, 0)), compiler_options=QUICK)
    found = hover(params.vehicle.constants, np.asarray(attitudes, np.float32))
    return jax.tree.map(np.asarray, found)


@pytest.mark.parametrize("vehicle", ["motor", "5inch"])
def test_rotation_in_the_observation(vehicle):
    """The body's x and z axes in the gate's frame, for Euler angles and for quaternions."""
    euler = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [np.pi, 1.5, np.pi]
    if vehicle == "motor":
        race = make_race("observation.attitude=rotation", TRACK)
        rows = np.zeros((200, 22))
        rows[:, ref.EULER], rows[:, ref.RPM] = euler, 7000.0
        state = race_state("motor", rows)
    else:
        race = make_race("observation.attitude=rotation", TRACK, f"vehicle={vehicle}")
        state = states(race, euler)
    layout = race[0].layout
    found = compiled_observe(race[0])(race[1], state)[:, layout.slice("rotation")]
    gate = ref.elementary(2, np.full(1, np.pi / 2))
    matrix = np.swapaxes(gate, 1, 2) @ ref.rotation(euler)
    np.testing.assert_allclose(
        found, np.concatenate([matrix[..., 0], matrix[..., 2]], 1), atol=1e-5
    )
    assert layout.size == (27 if vehicle == "motor" else 23) and "attitude" not in layout


def test_gradient_through_the_race_at_any_attitude():
    """A step at attitudes without unique angles ends no episode; gradients are finite."""
    choices, params = make_race(TRACK, "reward.pitch_up=1", "vehicle=5inch")
    one_gate = track_of([[float(x[0]) for x in params.track.position]], [np.pi / 2])
    race = choices, params = choices, params.replace(track=one_gate)

    def value(state, action):
        after, reward, outcome = environment.transition(choices, params, state, action)
        both = jax.tree.map(lambda *each: jnp.stack(each), state, after)
        seen = jax.vmap(lambda each: environment.observe(choices, params, each))(both)
        return reward + jnp.sum(seen), outcome.crashed

    def one(drone, state, action):
        return value(state.replace(drone=drone), action)

    slope = jax.jit(
        jax.vmap(jax.value_and_grad(one, (0, 2), has_aux=True), in_axes=(0, 0, None)),
        compiler_options=QUICK,
    )
    begin = states(race, ATTITUDES)
    (_, ended), found = slope(begin.drone, begin, np.full(4, -0.2, np.float32))
    assert not np.any(ended)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
    assert np.abs(found[1]).min() > 0


def test_thrusts_without_a_lag_are_those_of_the_command():
    choices, params = make_race("vehicle=cpc", TRACK)
    state = states((choices, params), ATTITUDES[:1])
    action = np.float32([[-1.0, 0.0, 1.0, 3.0]])
    after = compiled_transition(choices)(params, state, action)[0].drone
    thrusts = [x[0] for x in after.actuators]
    np.testing.assert_allclose(thrusts, [0, 0.5 * 6.879, 6.879, 6.879], rtol=1e-6)


def test_every_rotor_has_its_own_draw():
    choices, params = make_race(
        "vehicle=5inch",
        TRACK,
        "randomization.all=0.3",
        "randomization.constants={k_w: 0.1, tau: 0}",
    )
    drawn = compiled_reset(choices)(params, jax.random.key(0), 4000).constants
    nominal = values_of(params.vehicle.constants)
    spread = {"k_w": 0.1, "tau": 0.0, "g": 0.0}
    factors = {}
    for name, values in values_of(drawn).items():
        factors[name] = np.asarray(values) / float(nominal[name])
        half = 0.0 if name.startswith("turning") else spread.get(name, 0.3)
        np.testing.assert_allclose(
            [factors[name].min(), factors[name].max()], [1 - half, 1 + half], atol=2e-3
        )
    table = np.stack(
        [factors[f"{name}{i}"] for name in ("k_p", "k_q", "k_r") for i in (1, 2, 3, 4)]
    )
    assert np.abs(np.corrcoef(table) - np.eye(12)).max() < 0.08


def test_population_of_all_racing_drones():
    """The ranges of arXiv 2504.21586, with the sums and products that it draws."""
    choices, params = make_race(
        "vehicle=5inch", TRACK, "randomization.population=all_racing_drones"
    )
    drawn = compiled_reset(choices)(params, jax.random.key(1), 4000).constants
    c = {name: np.asarray(value, float) for name, value in values_of(drawn).items()}
    w = c["w_max"]
    for values, low, high in (
        (c["w_min"], 0, 500),
        (w, 3000, 5000),
        (c["k"], 0, 1),
        (c["tau"], 0.01, 0.1),
        (c["k_w"] * w**2, 10, 30),
        (c["k_x"] * w, 0.1, 0.3),
        (c["k_y"] * w, 0.1, 0.3),
        (c["k_r3"] * w, 20, 80),
        (c["k_rd2"] * w, 2, 8),
        ((c["k_p1"] - c["k_p4"]) * w**2, -100, 100),
        (np.mean([c[f"k_q{i}"] for i in (1, 2, 3, 4)], axis=0) * w**2, 200, 800),
    ):
        assert abs(values.min() - low) < 0.06 * (high - low)
        assert abs(values.max() - high) < 0.06 * (high - low)
    np.testing.assert_array_equal(c["k_r1"], c["k_r4"])
    np.testing.assert_array_equal(c["turning2"], 1.0)
