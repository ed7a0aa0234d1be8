"""Schedules of a config: which numbers of a run they change, and when."""

import jax
import numpy as np
import pytest

from quadjax.config.assembly import make_environment, make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.learners.schedules import Training
from quadjax.training.build import input_scale, make_training

TINY = [
    "learner.num_envs=16",
    "learner.horizon=4",
    "learner.critic_minibatches=2",
    "network.hidden=[8]",
    "run.steps=640",
    "run.evaluate_every=64",
]
TURN = [
    "start.heading=inside_turn",
    "schedules.start.yaw_deg={linear: [0.0, value], from: 0.125, until: 0.3125}",
]


def at(config, *updates):
    """Hyperparameters and race after each number of updates, of 64 steps each."""
    training, plan = make_training(config)
    assert plan.steps_per_update == 64
    found = [jax.device_get(jax.jit(Training.at)(training, np.int32(x))) for x in updates]
    return [(learner, task.env_params) for learner, task in found]


def tiny(name, *overrides):
    return load_config(name, [*TINY, *overrides])


def test_schedules_from_start_to_end():
    """Of 10 updates, yaw and pitch change from 1.25 to 3.125, the residual to 5.625."""
    config = tiny("e2e +residual", "observation.disturbance=estimated", *TURN)
    shares = {0: (0, 0), 1: (0, 0), 2: (0.4, 0), 4: (1, 0.35), 5: (1, 0.75), 6: (1, 1), 10: (1, 1)}
    for (update, (turned, residual)), (hyper, params) in zip(
        shares.items(), at(config, *shares), strict=True
    ):
        assert float(params.start.yaw_deg) == pytest.approx(turned * 180, abs=1e-4)
        assert float(params.reward.pitch_up) == pytest.approx(2 * (1 - turned), abs=1e-6)
        for vehicle in (params.vehicle, params.estimator.vehicle):
            assert float(vehicle.residual.gain) == pytest.approx(residual, abs=1e-6)
        rate = 3e-3 + 0.1 * update * (1.5e-4 - 3e-3)
        assert float(hyper.learning_rate) == pytest.approx(rate, rel=1e-5)
        assert float(params.reward.gate) == 10.0
    inside = np.radians([90.0, 180.0, -90.0, 0.0])  # of the legs to the paper's four gates
    np.testing.assert_allclose(np.exp(1j * np.asarray(params.heading)), np.exp(1j * inside))


def test_steps_and_the_keys_own_value():
    schedule = "schedules.reward.gate={linear: [1, 3, 2], from: 64, until: 320}"
    config = tiny("e2e +fastest", "reward.gate_edge=40", "learner.std=0.4", schedule)
    changed = [(h.std, p.reward.gate_edge, p.reward.gate) for h, p in at(config, 0, 3, 5, 10)]
    expected = [(0.4, 0, 1), (0.295, 24, 3), (0.225, 40, 2), (0.05, 40, 2)]
    np.testing.assert_allclose(changed, expected, rtol=1e-5)


def test_a_number_that_may_be_null_can_be_scheduled_where_it_is_not():
    for key in ("start.along_leg", "rules.body_radius"):
        section, name = key.split(".")
        schedule = f"schedules.{key}={{linear: [0, 0.2]}}"
        with pytest.raises(InputError, match=f"{key} is null, allowed: a key that"):
            tiny("e2e", schedule)
        found = at(tiny("e2e", f"{key}=0.1", schedule), 0, 5, 10)
        values = [getattr(getattr(params, section), name) for _, params in found]
        np.testing.assert_allclose(values, [0.0, 0.1, 0.2], atol=1e-6)


def test_a_schedule_does_not_change_the_factors_of_the_observation():
    """They are in the first layer of the policy file."""
    schedule = "schedules.vehicle.constants.g={linear: [value, 5.0]}"
    config = tiny("e2e", "network.normalize=true", schedule)
    for _, params in at(config, 0, 10):
        np.testing.assert_allclose(params.observation_scale, input_scale(config), rtol=1e-6)
    assert float(params.vehicle.constants.g) == pytest.approx(5.0)


def test_constants_and_randomization_can_be_scheduled():
    config = tiny("e2e", "schedules.vehicle.constants.tau={linear: [0.1, value]}")
    ((_, params),) = at(config, 5)
    assert float(params.vehicle.constants.tau) == pytest.approx(0.08)
    config = tiny("e2e", "schedules.randomization.drag={linear: [0, 0.2]}")
    assert make_environment(config).randomize
    ((_, params),) = at(config, 5)
    assert float(params.randomization.drag) == pytest.approx(0.1)


def test_a_constant_that_the_battery_does_not_depend_on_can_be_scheduled():
    config = tiny(
        "e2e", "battery.charge=[0.5, 1]", "schedules.vehicle.constants.k_x.linear=[0, value]"
    )
    ((_, params),) = at(config, 0)
    assert float(params.vehicle.constants.k_x) == 0.0


@pytest.mark.parametrize(
    ("words", "key"),
    [
        ((), "rules.time_step"),
        (("randomization.tracks={gates: 4, count: 2}",), "rules.position_limit"),
        (("battery.charge=[0.5, 1]",), "vehicle.constants.tau"),
        (("battery.charge=[0.5, 1]",), "battery.charge.0"),
    ],
)
def test_a_number_from_which_others_are_computed_cannot_be_scheduled_in_python(words, key):
    config = tiny("e2e", *words)
    with pytest.raises(InputError, match=f"{key} cannot be scheduled: .* computed from it"):
        config.learner.train(*make_race(config), steps=64, schedules={key: [0.01, 0.02]})


def test_up_to_three_names_are_close_to_one_that_no_number_has():
    config = tiny("e2e")
    with pytest.raises(
        InputError, match="mean reward.gate or reward.gate_offset or reward.gate_edge"
    ):
        config.learner.train(*make_race(config), steps=64, schedules={"reward.gates": [0, 1]})
