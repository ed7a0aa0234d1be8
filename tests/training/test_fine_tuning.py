"""Training that continues from a policy."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.cli import run
from quadjax.config.assembly import make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.core.vectors import Rotors, Vec3
from quadjax.policy.file import Policy
from quadjax.race import episode
from quadjax.training.build import (
    initial_policy,
    make_policy,
    make_training,
    start_state,
    untrained_policy,
)
from quadjax.training.fine_tuning import fine_tuning
from tests.evaluation.support import random_policy
from tests.race.support import BLANK, make_config

VALUE = ((np.ones((24, 8)), np.zeros(8)), (np.ones((8, 1)), np.zeros(1)))


def test_schedules_are_at_their_ends_and_learning_rates_fall(tmp_path):
    config, file = load_config("e2e_race", ["track=square4"]), tmp_path / "a.npz"
    random_policy(value=VALUE).save(file)
    own = fine_tuning(config, file)
    assert own.run.initial_policy == str(file)
    assert own.learner.learning_rate == pytest.approx(0.3 * config.learner.learning_rate)
    assert set(own.schedules) == {"learner.learning_rate", "learner.critic_learning_rate"}
    assert own.schedules["learner.learning_rate"].linear == ("value", 0.0)
    assert own.learner.discount == config.schedules["learner.discount"].linear[-1]
    assert own.learner.std == config.schedules["learner.std"].linear[-1] == 0.05
    assert own.reward == config.reward and own.training_limits == config.training_limits


def test_the_network_is_that_of_the_file_which_has_a_critic(tmp_path, capsys):
    file, bare = tmp_path / "small.npz", tmp_path / "bare.npz"
    small = make_config("network.hidden=[8]")
    policy = random_policy(value=VALUE)
    policy.save(file)
    found = initial_policy(fine_tuning(small, file))
    np.testing.assert_array_equal(found.layers[0][0], Policy.load(file).layers[0][0])
    has = r"has hidden widths \[8\], the config has \[6, 6\]$"
    with pytest.raises(InputError, match=rf"small.npz \(--fine-tune or run.initial_policy\) {has}"):
        initial_policy(fine_tuning(make_config("network.hidden=[6, 6]"), file))
    dataclasses.replace(policy, value=None).save(bare)
    for name, more, says in (
        (bare, (), "bare.npz has no critic, which fine-tuning needs; run.initial_policy="),
        (bare, (f"run.initial_policy={file}",), "run.initial_policy is set; fine-tuning sets it"),
    ):
        taken = ["train", str(BLANK), *more, "--fine-tune", str(name), "--output", str(tmp_path)]
        assert run(taken) == 2
        assert says in capsys.readouterr().err


def test_a_shipped_policy_is_known_by_its_name():
    own = fine_tuning(load_config("e2e"), "e2e")
    assert own.run.initial_policy == str(PRETRAINED / "e2e.npz")
    assert initial_policy(own).value is not None


RACES = {  # overrides of a race that goes on with a policy of the Bebop 1 and 3000 to 11000 rpm
    "as trained": [],
    "narrower limits": ["vehicle.constants.rpm_max=10500", "vehicle.constants.rpm_min=3200"],
    "wider limits": ["vehicle.constants.rpm_max=12000", "vehicle.constants.rpm_min=2500"],
    "other disturbances": ["disturbance.moment_x=0.08", "disturbance.force_z=0.5"],
    "no moment": ["disturbance.moment_x=0"],
    "another learner": ["learner.algorithm=shac"],  # whose noise is on the clipped mean
    "normalized": ["network.normalize=true", "vehicle.constants.rpm_max=10500"],
}


@pytest.mark.parametrize("race", RACES)
def test_a_training_starts_with_the_commands_of_the_file(race, tmp_path, recwarn):
    """In rpm, by the observations of the two races and a float64 computation of the networks."""
    of_both = ["network.hidden=[8]", "disturbance.moment_x=0.04", "disturbance.moment_y=0.02"]
    path, random = tmp_path / "first.npz", np.random.default_rng(0)
    first = make_config(*of_both)
    policy = untrained_policy(first)
    layers = tuple((k, 0.1 * random.normal(size=b.shape)) for k, b in policy.layers)
    dataclasses.replace(policy, layers=layers).save(path)
    config = make_config(*of_both, f"run.initial_policy={path}", *RACES[race])
    run, _ = make_training(config)
    initial, file = initial_policy(config), Policy.load(path)
    warned = " ".join(str(each.message) for each in recwarn)
    assert bool(warned) == ("this race of [2500.0, 2500.0" in warned) == (race == "wider limits")
    state = start_state(config, run, initial)
    trained = make_policy(config, state.params)
    environment, own = make_race(first)
    drone = episode.hover_start(environment, own)
    for _ in range(8):
        rpm = Rotors(*jnp.asarray(random.uniform(4000, 10000, 4), jnp.float32))
        moment = Vec3(*jnp.asarray([0.0 if race == "no moment" else 0.03, -0.01, 0.0]))
        body = drone.drone.replace(actuators=rpm, moment_ext=moment)
        now = drone.replace(drone=body)
        commands, values = [], []
        for each, (code, numbers) in ((file, (environment, own)), (trained, make_race(config))):
            seen = np.asarray(code.observation(numbers, now), np.float64)
            action = mlp(each.layers, seen)
            low, high = each.command_low, each.command_high
            commands.append(np.clip(low + (action + 1.0) / 2.0 * (high - low), 3200.0, 10500.0))
            values.append(mlp(each.value, seen))
        np.testing.assert_allclose(commands[1], commands[0], rtol=2e-6)
        np.testing.assert_allclose(values[1], values[0], rtol=1e-4, atol=1e-6)
    assert (file.noise_on == trained.noise_on) == (race != "another learner")
    width = np.exp(trained.log_std) * (trained.command_high - trained.command_low)
    own_width = np.exp(file.log_std) * (file.command_high - file.command_low)
    np.testing.assert_allclose(width, own_width, rtol=1e-6)
    if race == "as trained":
        for new, old in zip(trained.layers, file.layers, strict=True):
            np.testing.assert_array_equal(new[0], old[0])


def mlp(layers, values):
    """A network with ReLU in float64."""
    for index, (kernel, bias) in enumerate(layers):
        values = values @ np.asarray(kernel, np.float64) + bias
        values = np.maximum(values, 0.0) if index < len(layers) - 1 else values
    return values
