"""Variants of a task that are drawn by learning progress."""

import dataclasses

import jax
import numpy as np
import pytest
from flax import struct

from quadjax.core.environment import Environment, Variants
from quadjax.core.errors import InputError
from quadjax.learners import tasks
from quadjax.learners.state import AXIS, Learner
from quadjax.learners.tasks import Record, chances, learning_progress, variant_metrics

VARIANTS = Variants(3, index=lambda state: state, weighted=lambda params, share: share)


def counts(*pairs):
    return np.array(pairs, np.float32).T


def test_learning_progress_is_the_change_of_the_pass_rate():
    long = counts((900, 100), (500, 500), (0, 0))
    record = Record(counts((90, 10), (80, 20), (0, 0)), long)
    everywhere = 1400 / 2000
    slow = [(900 + 10 * everywhere) / 1010, (500 + 10 * everywhere) / 1010, everywhere]
    fast = [(90 + 10 * slow[0]) / 110, (80 + 10 * slow[1]) / 110, everywhere]
    expected = np.abs(np.subtract(fast, slow))
    assert learning_progress(record) == pytest.approx(expected, abs=1e-6)
    assert expected[1] > 0.25 and expected[0] < 0.002


def test_half_of_the_episodes_are_drawn_by_progress():
    record = Record(counts((0, 0), (80, 20), (0, 0)), counts((0, 0), (50, 50), (0, 0)))
    np.testing.assert_allclose(chances(record), [1 / 6, 1 / 6 + 0.5, 1 / 6], atol=1e-6)
    none = np.zeros((2, 3), np.float32)
    np.testing.assert_allclose(chances(Record(none, none)), np.full(3, 1 / 3), atol=1e-6)


def test_metrics_are_sums_of_each_variant_over_all_devices():
    index = np.array([[[0, 2], [0, 0]], [[1, 1], [2, 2]]])  # (devices, time, n)
    completed = np.array([[[1, 0], [1, 0]], [[0, 1], [0, 0]]], np.float32)
    terminated = np.array([[[0, 1], [0, 0]], [[1, 0], [0, 1]]], bool)

    def one(*each):
        return variant_metrics(VARIANTS, *each)

    found = jax.jit(jax.vmap(one, axis_name=AXIS))(index, completed, terminated)
    for device in range(2):
        assert found[tasks.COMPLETED][device].tolist() == [2, 1, 0]
        assert found[tasks.CRASHED][device].tolist() == [0, 1, 2]
    assert variant_metrics(None, None, completed, terminated) == {}


@struct.dataclass
class State:
    record: Record | None = None


def test_the_learner_draws_what_changes_and_forgets():
    gains = counts((50, 50), (100, 0), (50, 50))  # of every update
    metrics = {tasks.COMPLETED: gains[0], tasks.CRASHED: gains[1]}
    plain = Learner(
        init=lambda hyper, params, key: State(),
        update=lambda hyper, share, state: (state, metrics | {"share": share}),
        hyper=None,
        steps_per_update=1,
        num_shards=1,
    )
    environment = Environment(None, None, None, 1, 1, variants=VARIANTS)
    learner = tasks.with_learning_progress(plain, environment, updates=100)
    state = learner.init(None, None, None)
    before = counts((0, 0), (0, 100), (0, 0)) * 10.0  # the second variant was never passed
    state = state.replace(record=dataclasses.replace(state.record, long=before))
    state, found = learner.update(None, None, state)
    np.testing.assert_allclose(found["share"], np.full(3, 1 / 3), atol=1e-6)
    assert set(found) == {"share", "learning_progress"} and found["learning_progress"] > 0
    np.testing.assert_allclose(state.record.short, gains)  # half is kept after each update
    np.testing.assert_allclose(state.record.long, 0.9 * before + gains)
    _, found = learner.update(None, None, state)
    assert found["share"][1] > 0.5 and np.sum(found["share"]) == pytest.approx(1.0)
    for _ in range(200):
        state, found = learner.update(None, None, state)
    assert found["learning_progress"] < 5e-3  # the rates do not change any more
    assert tasks.with_learning_progress(plain, Environment(None, None, None, 1, 1), 9) is plain
    silent = dataclasses.replace(plain, update=lambda hyper, share, state: (state, {}))
    with pytest.raises(InputError, match=r"variants needs Environment.completed, and a learner wi"):
        tasks.with_learning_progress(silent, environment, 9).update(None, None, state)
