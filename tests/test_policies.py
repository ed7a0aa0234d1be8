"""What a policy does in training and in flight is one and the same."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core import mlp
from quadjax.learners.networks import mean_action, predict_value
from quadjax.policy.inference import act_deterministic, act_sampled
from quadjax.training.build import (
    first_params,
    input_scale,
    make_network,
    make_policy,
    network_policy,
    with_policy,
)
from tests.race.support import BLANK


@pytest.mark.parametrize("algorithm", ["ppo", "shac"])
def test_training_and_flight_share_one_head(algorithm):
    """Noise comes on top of the same mean, also where the network is far beyond the limits."""
    config = load_config(BLANK, ["network.hidden=[8]", f"learner.algorithm={algorithm}"])
    network, params = make_network(config), first_params(config, 0)
    first, (kernel, bias) = mlp.to_layers(params["actor"])
    params = {**params, "actor": mlp.to_params((first, (300.0 * kernel, bias)))}
    seen = jax.random.normal(jax.random.key(1), (64, first[0].shape[0]))
    raw = np.asarray(mlp.apply(params["actor"], seen))
    assert (raw > 1.5).any() and (raw < -1.5).any() and (np.abs(raw) < 0.9).any()
    trained = np.asarray(mean_action(network, params, seen))
    np.testing.assert_array_equal(trained, np.clip(raw, -1, 1) if algorithm == "shac" else raw)
    policy = make_policy(config, params).on_device()
    noise = jnp.full((64, 4), -0.3)
    flown = jax.vmap(act_deterministic, in_axes=(None, 0, 0))(policy, seen, noise)
    np.testing.assert_allclose(flown, trained, atol=1e-5)
    sampled = jax.vmap(act_sampled, in_axes=(None, 0, 0))(policy, seen, noise)
    np.testing.assert_allclose(sampled, trained - 0.3 * np.exp(params["log_std"]), atol=1e-5)


def test_normalized_networks_fly_as_they_train_and_are_read_back():
    """The factors on the observation are a part of the first layer of the file's networks."""
    keys = ["network.hidden=[8]", "network.normalize=true", "track=split_s"]
    config = load_config(BLANK, keys)
    network, scale = make_network(config), np.float32(input_scale(config))
    assert scale[0] < 0.5  # legs of 10 m
    params = first_params(config, 0)
    params = {**params, "actor": jax.tree.map(lambda x: 10.0 * x, params["actor"])}
    seen = 5.0 * jax.random.normal(jax.random.key(1), (64, len(scale)))
    trained = mean_action(network, params, scale * seen)
    policy = make_policy(config, params)
    for found in (policy.on_device(), network_policy(config, params)):
        flown = jax.vmap(act_deterministic, in_axes=(None, 0, 0))(found, seen, jnp.zeros((64, 4)))
        np.testing.assert_allclose(flown, trained, rtol=1e-3, atol=1e-3)
    read = with_policy(first_params(config, 2), policy, 1.0, input_scale(config))
    for output in (mean_action, predict_value):
        trained, again = (output(network, x, scale * seen) for x in (params, read))
        np.testing.assert_allclose(again, trained, rtol=1e-3, atol=1e-3)
