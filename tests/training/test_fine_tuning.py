"""Training that continues from a policy."""

import dataclasses

import numpy as np
import pytest

from quadjax.cli import run
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.policy.file import Policy
from quadjax.training.build import initial_policy
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
