"""The race of drones whose attitude is a quaternion: any attitude, its observation and gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.vectors import Vec3
from quadjax.race.types import RaceState
from quadjax.vehicle.protocol import Motion
from tests import reference as ref
from tests.promotion import QUICK
from tests.race.support import (
    compiled_observe,
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
    environment, params = race
    gate = np.array([float(x[0]) for x in params.track.position])
    still = [np.zeros(3, np.float32)] * 4
    still[0], still[1] = np.float32(gate - [0, 1, 0]), np.float32([0, 3, 0])

    def one(constants, euler):
        motion = Motion(*(Vec3.of(x) for x in (still[0], still[1], euler, still[3])))
        drone = environment.model.hover(constants, motion)
        zero = jnp.zeros((), jnp.int32)
        return RaceState(drone, zero, zero, zero, None)

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


@pytest.mark.slow
def test_gradient_through_the_race_at_any_attitude():
    """A step at attitudes without unique angles ends no episode; gradients are finite."""
    environment, params = make_race(TRACK, "reward.pitch_up=1", "vehicle=5inch")
    one_gate = track_of([[float(x[0]) for x in params.track.position]], [np.pi / 2])
    params = params.replace(track=one_gate)
    race = environment, params

    def value(state, action):
        after, reward, outcome = environment.transition(params, state, action)
        both = jax.tree.map(lambda *each: jnp.stack(each), state, after)
        seen = jax.vmap(lambda each: environment.observation(params, each))(both)
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
