"""Restarts from states of earlier flights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.learners.revisits import remember, restarts
from tests.learners.probes import State

SHARDS, COUNT = 2, 64
NUMBER = SHARDS * COUNT


def states(first):
    """A state of every environment, each with its own place."""
    place = first + jnp.arange(NUMBER, dtype=jnp.float32)
    return State(jnp.ones(NUMBER), jnp.zeros(NUMBER), place)


@pytest.fixture
def keys():
    return jax.random.split(jax.random.key(3), SHARDS)


def test_the_fraction_of_restarts_from_the_buffer(keys):
    buffer, fresh = states(1000.0), states(0.0)
    for fraction, low, high in ((0.0, 0, 0), (1.0, NUMBER, NUMBER), (0.5, 0.3 * NUMBER, 90)):
        found = restarts(buffer, fresh, keys, fraction)
        revisited = np.asarray(found.place) >= 1000
        assert low <= revisited.sum() <= high
        np.testing.assert_array_equal(found.place[~revisited], fresh.place[~revisited])


def test_a_shard_restarts_only_from_its_own_part(keys):
    found = np.asarray(restarts(states(0.0), states(-1.0), keys, 1.0).place)
    assert found[:COUNT].max() < COUNT <= found[COUNT:].min()
    assert sorted(found) == list(range(NUMBER))
    assert list(found) != list(range(NUMBER))


def test_only_states_of_flights_that_survive_are_kept(keys):
    survived = jnp.arange(NUMBER) % 2 == 0
    found = np.asarray(remember(states(0.0), states(1000.0), survived, keys).place)
    kept = found >= 1000
    assert 0 < kept.sum() < NUMBER / 4
    assert not kept[1::2].any()
    np.testing.assert_array_equal(found[~kept], np.arange(NUMBER)[~kept])


def test_the_same_keys_give_the_same_states(keys):
    once, again = (restarts(states(5.0), states(0.0), keys, 0.5).place for _ in range(2))
    np.testing.assert_array_equal(once, again)
