"""Observations, rate limits and penalties beyond the published ones, against float64 versions."""

import types

import jax
import numpy as np
import pytest

from quadjax.core.vectors import Rotors
from quadjax.race.step import Step
from quadjax.race.track import gates_ahead
from tests import reference as ref
from tests.race.support import (
    compiled_observe,
    compiled_reset,
    compiled_transition,
    level,
    make_race,
    race_state,
    track_of,
)


def ahead_of(index, count, centers, yaw):
    """The pose of a later gate in a gate's frame, float64."""
    other = (index + count) % len(centers)
    turn = ref.elementary(2, np.array(yaw[index]))
    return turn.T @ (centers[other] - centers[index]), ref.wrap(yaw[other] - yaw[index])


@pytest.mark.parametrize("gates", [1, 5])
def test_gates_after_the_next_one_are_observed(gates):
    draw = np.random.default_rng(gates)
    centers, yaw = draw.uniform(-5, 5, (gates, 3)), draw.uniform(-4, 8, gates)
    choices, params = make_race("observation.gates_ahead=3")
    params = params.replace(track=track_of(centers, yaw))
    state = race_state("motor", level(np.zeros((gates, 3)), np.zeros(3)), np.arange(gates))
    found = compiled_observe(choices)(params, state)
    for index in range(gates):
        for count in (2, 3):
            place, turn = ahead_of(index, count, centers, yaw)
            position = found[index, choices.layout.slice(f"next{count}_position")]
            np.testing.assert_allclose(position, place, atol=2e-5)
            angle = found[index, choices.layout.slice(f"next{count}_yaw")]
            assert abs(ref.wrap(angle[0] - turn)) < 1e-5


def test_gates_after_the_end_of_a_course_are_straight_ahead():
    track = track_of(ref.GATES, ref.GATE_YAW, closed=False)
    place, yaw = jax.jit(gates_ahead, static_argnums=1)(track, 2)
    position = np.stack([*place], axis=-1)
    np.testing.assert_allclose(position[-1], [10, 0, 0], atol=1e-5)
    last, turn = ahead_of(2, 1, ref.GATES, ref.GATE_YAW)
    beyond = last + 5.0 * np.array([np.cos(turn), np.sin(turn), 0.0])
    np.testing.assert_allclose(position[2], beyond, atol=1e-5)
    assert abs(float(yaw[2]) - turn) < 1e-6 and float(yaw[3]) == 0


def test_actuators_are_scaled_by_a_given_range():
    choices, params = make_race(
        "vehicle=5inch", "track=figure8_tudelft", "observation.actuator_range=[0, 3000]"
    )
    assert choices.layout.size == 20  # the published observation of racing quadcopters
    field = choices.layout.with_spans(choices.model, params)["rotor_speed"]
    assert field.span == ((0.0, 3000.0),) * 4
    speeds = Rotors(*np.float32([0.0, 1500, 3000, 600]))
    drone = types.SimpleNamespace(actuators=speeds)
    found = field.numbers(Step(choices.model, params, types.SimpleNamespace(drone=drone), None))
    np.testing.assert_allclose(found, [-1, 0, 1, -0.6], atol=1e-6)


SIGHT = ("reward.perception=0.5", "reward.camera_deg=40", "reward.perception_deg=30")


@pytest.fixture(scope="module")
def stepped():
    """One step with every penalty and with none, of drones anywhere; the step before had 0.5."""
    more = ("reward.action_change=0.25", "observation.last_action=true")
    race, plain = make_race(*SIGHT, *more), make_race()
    rows = ref.random_states("motor", 200)
    state = race_state("motor", rows, np.arange(200) % 4)
    before = (np.full(200, 0.5, np.float32),) * 4
    action = np.random.default_rng(0).uniform(-1.5, 1.5, (200, 4)).astype(np.float32)
    found = compiled_transition(race[0])(race[1], state.replace(action=before), action)
    _, without, _ = compiled_transition(plain[0])(plain[1], state, action)
    return race, state, action, found, without


def test_penalties_of_the_cameras_view_and_of_changes_of_the_action(stepped):
    """The angle between the camera's axis and the gate's center, after the step, in float64."""
    _, state, action, (following, value, outcome), without = stepped
    tilt = np.radians(40)
    axis = np.array([np.cos(tilt), 0, -np.sin(tilt)])
    drone = following.drone
    matrix = ref.rotation(np.stack([drone.euler.x, drone.euler.y, drone.euler.z], 1))
    place = np.stack([drone.position.x, drone.position.y, drone.position.z], 1)
    seen = np.einsum("nji,nj->ni", matrix, ref.GATES[state.target] - place)
    angle = np.arccos(seen @ axis / np.linalg.norm(seen, axis=1))
    unseen = 0.01 * 0.5 * np.maximum(angle - np.radians(30), 0) * ~outcome.passed
    assert unseen.max() > 0.01 and (unseen == 0).any()
    change = 0.25 * np.abs(np.clip(action, -1, 1) - 0.5).sum(axis=1)
    np.testing.assert_allclose(without - value, unseen + change, atol=1e-4)


def test_the_action_of_the_step_before_is_observed(stepped):
    (choices, params), state, action, (following, _, _), _ = stepped
    columns = choices.layout.slice("last_action")
    assert columns.stop - columns.start == 4
    found = compiled_observe(choices)(params, following)
    np.testing.assert_allclose(found[:, columns], np.clip(action, -1, 1), atol=1e-6)
    first = compiled_reset(choices)(params, jax.random.key(0), 2)
    np.testing.assert_allclose(compiled_observe(choices)(params, first)[:, columns], 0, atol=1e-6)


def test_penalties_that_are_scheduled_are_computed():
    race = make_race(*SIGHT[1:], "schedules.reward.perception.linear=[0, 1]")
    assert race[1].reward.perception is not None and race[1].reward.action_change is None
    assert make_race()[1].reward.perception is None
