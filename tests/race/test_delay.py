"""Commands that act later: of a command and the one before it, the mean over the step acts."""

import jax
import numpy as np
import pytest

from quadjax.race import episode
from quadjax.race.layout import LAST_ACTION
from tests import reference as ref
from tests.race.support import compiled_reset, make_race

STEP, RANGE = 0.01, (0.002, 0.008)
OVERRIDES = (f"vehicle.delay={list(RANGE)}", "start.gate=first")


@pytest.mark.parametrize("kind", ["motor", "rate"])
def test_a_delayed_command_acts_for_the_rest_of_the_step(kind):
    environment, params = make_race(*OVERRIDES, f"vehicle.model={kind}")
    state = compiled_reset(environment)(params, jax.random.key(0), 1)
    state = jax.tree.map(lambda x: x[0], state)
    before, now, late = np.array([-0.5, 0.2, 0.0, 0.7]), np.array([0.5, -1.0, 0.1, 3.0]), 0.004
    state = state.replace(memories={LAST_ACTION: tuple(before)}, delay=np.float32(late))
    after, _, _ = environment.transition(params, state, now)
    low, high = (
        np.array(jax.tree.leaves(x))
        for x in environment.model.command_range(params.vehicle.constants)
    )
    sent = [low + 0.5 * (high - low) * (np.clip(x, -1, 1) + 1) for x in (before, now)]
    acting = sent[1] + late / STEP * (sent[0] - sent[1])
    if kind == "motor":
        start = np.array([float(w) for w in jax.tree.leaves(state.drone.actuators)])
        expected = start + STEP * (acting - start) / ref.MOTOR["tau"]
        found = [float(w) for w in jax.tree.leaves(after.drone.actuators)]
        np.testing.assert_allclose(found, expected, rtol=1e-5)
    else:
        start, constants = float(state.drone.actuators), params.vehicle.constants
        expected = start + STEP * (acting[3] - start) / float(constants.tau_thrust)
        np.testing.assert_allclose(float(after.drone.actuators), expected, rtol=1e-5)
    np.testing.assert_allclose(after.memories[LAST_ACTION], np.clip(now, -1, 1), rtol=1e-6)
    assert float(after.delay) == np.float32(late)


def test_a_delay_is_drawn_for_every_episode_and_is_the_middle_of_its_range_in_timed_laps():
    environment, params = make_race(*OVERRIDES)
    drawn = np.asarray(compiled_reset(environment)(params, jax.random.key(1), 2000).delay)
    assert RANGE[0] <= drawn.min() < 0.0021 and 0.0079 < drawn.max() <= RANGE[1]
    np.testing.assert_allclose(drawn.mean(), 0.005, atol=1e-4)
    timed = episode.hover_start(environment, params)
    np.testing.assert_allclose(timed.delay, 0.005, rtol=1e-6)


def test_no_delay_changes_nothing():
    environment, params = make_race("start.gate=first")
    state = compiled_reset(environment)(params, jax.random.key(0), 1)
    assert params.delay is None and state.delay is None and not state.memories
