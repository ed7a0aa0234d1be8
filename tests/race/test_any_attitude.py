"""The race of drones whose attitude is a quaternion: any attitude, its observation and gradient."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.race import environment
from quadjax.vehicle.protocol import Motion
from tests import reference as ref
from tests.race.support import compiled_observe, compiled_reset, make_race, race_state
from tests.race.test_gradient import QUICK

TRACK = "track=figure8_tudelft"
# Roll, pitch, yaw: level, nose up, nose down, inverted, and inverted by pitching through 90 deg.
ATTITUDES = np.array(
    [[0.1, 0.2, 0.3], [0, np.pi / 2, 0], [0.5, -np.pi / 2, 2], [np.pi, 0, 0], [0, 2.5, 0]]
)


def states(race, attitudes):
    """Drones in hover 1 m before the first gate, but for their attitudes and a forward speed."""
    choices, params = race
    gate = np.array([leaf[0] for leaf in jax.tree.leaves(params.track.position)])

    def one(euler):
        zero, zero_steps = jnp.zeros(()), jnp.zeros((), jnp.int32)
        position = Vec3(*(jnp.asarray(x, jnp.float32) for x in gate - [0, 1, 0]))
        motion = Motion(position, Vec3(zero, zero + 3.0, zero), Vec3.of(euler), Vec3.zero())
        drone = choices.model.hover(params.vehicle.constants, motion)
        return environment.RaceState(drone, zero_steps, zero_steps, zero_steps, None)

    return jax.vmap(one)(jnp.asarray(attitudes, jnp.float32))


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
    found = np.asarray(compiled_observe(race[0])(race[1], state))[:, layout.slice("rotation")]
    gate = ref.elementary(2, np.full(1, np.pi / 2))
    matrix = np.swapaxes(gate, 1, 2) @ ref.rotation(euler)
    np.testing.assert_allclose(
        found, np.concatenate([matrix[..., 0], matrix[..., 2]], 1), atol=1e-5
    )
    assert layout.size == (27 if vehicle == "motor" else 23) and "attitude" not in layout


@pytest.mark.parametrize(
    "overrides",
    [
        ("vehicle=5inch",),
        pytest.param(
            ("vehicle.quaternion=true", "observation.attitude=rotation"), marks=pytest.mark.slow
        ),
    ],
)
def test_gradient_through_the_race_at_any_attitude(overrides):
    """A step at attitudes without unique angles ends no episode; gradients are finite."""
    race = make_race(TRACK, "reward.pitch_up=1", *overrides)
    choices, params = race

    def value(state, actions):
        total = jnp.zeros(())
        for action in actions:
            total = total + jnp.sum(environment.observe(choices, params, state))
            state, reward, outcome = environment.transition(choices, params, state, action)
            total = total + reward
        return total + jnp.sum(environment.observe(choices, params, state)), outcome.terminated

    def one(drone, state, actions):
        return value(state.replace(drone=drone), actions)

    slope = jax.jit(
        jax.vmap(jax.value_and_grad(one, (0, 2), has_aux=True), in_axes=(0, 0, None)),
        compiler_options=QUICK,
    )
    begin = states(race, ATTITUDES)
    (_, ended), found = slope(begin.drone, begin, jnp.full((1, 4), -0.2))
    assert not np.any(ended)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(found))
    assert np.abs(found[1]).min() > 0


def test_pitch_limit_of_the_training():
    infinite = make_race("vehicle=5inch", TRACK)[1].limits.pitch
    limited = make_race("vehicle=5inch", TRACK, "training_limits.pitch_deg=60")[1].limits.pitch
    angles = make_race()[1].limits.pitch
    np.testing.assert_allclose([infinite, limited, angles], [np.inf, *np.radians([60, 85])])


def test_thrusts_without_a_lag_are_those_of_the_command():
    choices, params = make_race("vehicle=cpc", TRACK)
    state = jax.tree.map(lambda x: x[0], states((choices, params), ATTITUDES))
    step = jax.jit(functools.partial(environment.transition, choices), compiler_options=QUICK)
    after = step(params, state, jnp.asarray([-1.0, 0.0, 1.0, 3.0]))[0].drone
    np.testing.assert_allclose(after.rotors.array(), [0, 0.5 * 6.879, 6.879, 6.879], rtol=1e-6)


def test_every_rotor_has_its_own_draw():
    choices, params = make_race(
        "vehicle=5inch",
        TRACK,
        "randomization.all=0.3",
        "randomization.constants={k_w: 0.1, tau: 0}",
    )
    keys = jax.random.split(jax.random.key(0), 4000)
    drawn = compiled_reset(choices)(params, keys).constants
    nominal = params.vehicle.constants
    spread = {"k_w": 0.1, "tau": 0.0, "g": 0.0}
    factors = {}
    for name, values in vars(drawn).items():
        factors[name] = np.asarray(values) / float(getattr(nominal, name))
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
    drawn = compiled_reset(choices)(params, jax.random.split(jax.random.key(1), 4000)).constants
    c = {name: np.asarray(value, float) for name, value in vars(drawn).items()}
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
    with pytest.raises(InputError, match=r"allowed: null with fractions \(here 0"):
        make_race("vehicle=5inch", "randomization={population: all_racing_drones, lag: 0.1}")
    with pytest.raises(
        InputError, match="randomization.population is 'all', allowed: null with model motor"
    ):
        make_race("randomization.population=all")
