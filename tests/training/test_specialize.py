"""Policies that observe the drone's constants, and the policy of one drone made from one."""

import jax
import numpy as np
import pytest

import quadjax
from quadjax.config.assembly import make_race, race_of
from quadjax.core.errors import InputError
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.specialize import outside, specialize
from quadjax.race.environment import make_environment
from quadjax.training.build import untrained_policy
from tests.race.support import BLANK, make_config

SEES = "observation.constants=true"
DRAWN = "randomization={thrust: 0.2, lag: 0.1}"
SMALL = "network.hidden=[8]"


def observed(environment, params, keys):
    """First states and their observations, in one program."""

    def first(key):
        state = environment.reset(params, key)
        return state, environment.observe(params, state)

    return jax.device_get(jax.jit(jax.vmap(first))(keys))


def test_drawn_constants_are_observed_from_minus_one_to_one():
    config = make_config(DRAWN, SEES)
    environment, params = make_race(config)
    states, seen = observed(environment, params, jax.random.split(jax.random.key(0), 100))
    names = race_of(config)[0].model.constant_names
    seen = dict(zip(names, seen[:, -len(names) :].T, strict=True))
    for name, part in (("k_w", 0.2), ("tau", 0.1)):
        own = float(getattr(params.vehicle.constants, name))
        drawn = np.asarray(getattr(states.constants, name), np.float64)
        np.testing.assert_allclose(seen[name], (drawn / own - 1.0) / part, atol=1e-4)
        assert np.ptp(seen[name]) > 1.8
    assert not any(seen[name].any() for name in set(names) - {"k_w", "tau"})


POPULATION = pytest.param("randomization.population=all_racing_drones", marks=pytest.mark.slow)


@pytest.mark.parametrize("drawn", [DRAWN, POPULATION])
def test_the_policy_of_a_drone_acts_as_the_one_that_sees_its_constants(drawn):
    model = "vehicle=5inch" if "population" in drawn else "vehicle.constants.k_w=4.2e-8"
    other = "vehicle=3inch" if "population" in drawn else "vehicle.constants.k_w=4.5e-8"
    policy = untrained_policy(make_config(model, drawn, SEES, SMALL))
    config = make_config(other)
    choices, params = pilot.fit_race(*race_of(config), policy)
    own = specialize(policy, config)
    assert "constants" not in own.layout and own.layers[0][0].shape[0] == own.layout.size
    assert own.value[0][0].shape[0] == own.layout.size
    environment, plain = make_race(config)
    flown = pilot.make_pilot(choices, params, policy, deterministic=True)

    @jax.jit
    def see(key):
        state = environment.reset(plain, key)
        return pilot.see(flown, make_environment(choices).observe(params, state))

    seen = np.asarray(see(jax.random.key(3)))
    kept = np.delete(seen, policy.layout.slice("constants"))
    np.testing.assert_allclose(own.mean(kept), policy.mean(seen), atol=2e-5)
    assert own.config["observation"]["constants"] is False


def test_what_cannot_be_specialized_is_refused(tmp_path):
    with pytest.raises(InputError, match="does not observe constants, allowed: a policy that was"):
        specialize(untrained_policy(make_config(SMALL)), quadjax.load(BLANK))
    seeing = untrained_policy(make_config(DRAWN, SEES, SMALL))
    with pytest.raises(InputError, match="a policy for the motor vehicle; vehicle.model of the"):
        specialize(seeing, make_config("vehicle=5inch"))
    specialize(seeing, quadjax.load(BLANK)).save(tmp_path / "one.npz")
    assert "constants" not in Policy.load(tmp_path / "one.npz").layout
    assert outside(seeing, quadjax.load(BLANK)) == []
    far = ["vehicle.constants.k_w=9e-8", "vehicle.constants.k_x=1e-4"]
    assert outside(seeing, quadjax.load(BLANK, far)) == ["k_x", "k_w"]
