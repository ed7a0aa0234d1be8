"""A critic that observes the drawn constants, which the policy does not."""

import functools

import jax
import numpy as np
import pytest

from quadjax.config.assembly import make_race
from quadjax.core.errors import InputError
from quadjax.learners.networks import mean_action, predict_value
from quadjax.learners.schedules import Training
from quadjax.training.build import (
    critic_constants,
    first_params,
    input_scale,
    make_network,
    make_policy,
    make_training,
    training_environment,
    with_policy,
)
from tests.race.support import make_config

SMALL = "network.hidden=[8]"
OWN = ("randomization={thrust: 0.2, lag: 0.1}", "observation.critic_constants=true")


def test_the_observation_of_training_ends_with_the_drawn_constants():
    config, (plain, params) = make_config(*OWN), make_race(make_config(OWN[0]))
    environment = training_environment(config)
    assert critic_constants(config) == (("k_w", 0.2), ("tau", 0.1))
    assert environment.observation_size == plain.observation_size + 2
    state = jax.jit(plain.reset)(params, jax.random.key(1))
    seen = jax.jit(environment.observe)(params, state)
    np.testing.assert_array_equal(seen[:-2], jax.jit(plain.observe)(params, state))
    nominal = make_race(config)[1].vehicle.constants
    for found, name, most in zip(seen[-2:], ("k_w", "tau"), (0.2, 0.1), strict=True):
        error = float(getattr(state.constants, name)) / float(getattr(nominal, name)) - 1.0
        assert abs(error) > 1e-3
        assert float(found) == pytest.approx(error / most, abs=1e-4)


def test_only_the_value_takes_them():
    config = make_config(*OWN, SMALL, "network.normalize=true")
    network, params = make_network(config), first_params(config, 0)
    size = training_environment(config).observation_size
    seen = np.random.default_rng(1).normal(size=size).astype(np.float32)
    other = seen.copy()
    other[-2:] += 1.0
    mean, value = (jax.jit(functools.partial(f, network)) for f in (mean_action, predict_value))
    np.testing.assert_array_equal(mean(params, seen), mean(params, other))
    assert abs(value(params, seen) - value(params, other)) > 1e-3
    policy = make_policy(config, params)
    assert policy.layers[0][0].shape[0] == policy.layout.size == size - 2
    assert policy.value is None
    action = policy.mean(seen[:-2] / np.float32(input_scale(config)))
    np.testing.assert_allclose(action, np.clip(mean(params, seen), -1, 1), atol=1e-5)


def test_a_policy_with_a_critic_of_another_size_gives_its_policy_only():
    plain = make_config(OWN[0], SMALL)
    policy = make_policy(plain, first_params(plain, 3))
    params = first_params(make_config(*OWN, SMALL), 0)
    found = with_policy(params, policy, 1.0)
    assert found["critic"] is params["critic"] and policy.value is not None
    np.testing.assert_array_equal(found["actor"]["Dense_0"]["kernel"], policy.layers[0][0])


def test_scheduled_draws_are_observed_only_where_there_is_a_width():
    scheduled = "schedules={randomization.all: {linear: [0.0, 0.2]}}"
    with pytest.raises(InputError, match="critic_constants is true, allowed: false where rand"):
        make_config(scheduled, OWN[1])
    assert critic_constants(make_config("randomization.all=0.2", scheduled, OWN[1]))


@pytest.mark.parametrize("algorithm", ["ppo", pytest.param("shac", marks=pytest.mark.slow)])
def test_both_learners_have_a_program_with_it(algorithm):
    config = make_config(*OWN, SMALL, f"learner.algorithm={algorithm}")
    training, _ = make_training(config)
    state = jax.eval_shape(Training.init, training, jax.random.key(0))
    after, _ = jax.eval_shape(Training.update, training, state)
    assert jax.tree.structure(after) == jax.tree.structure(state)
