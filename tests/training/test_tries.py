"""The best of several short trainings goes on."""

import dataclasses
import types

import numpy as np
import pytest

import quadjax
from quadjax.config.loading import load_config
from quadjax.learners.loop import Hooks
from quadjax.training.metrics import read_metrics
from quadjax.training.tries import best_try
from tests.test_training import TINY, TINY_LEARNER


@dataclasses.dataclass
class Log:
    """Hooks that record what is reported."""

    rows: list
    stop: bool = False

    def hooks(self):
        return Hooks(None, self.rows.append, None, lambda: self.stop)


def started(index):
    return types.SimpleNamespace(evaluated=np.array(index), index=index)


def trained(rewards, log, stop_at=None):
    """A try of two chunks, the second with the reward of its index."""

    def train(position, hooks):
        index = position.state.index
        hooks.report({"steps": 1, "reward": 9.0 - index})
        hooks.report({"steps": 2, "reward": rewards[index]})
        hooks.save(position)
        log.stop = index == stop_at
        return position

    return train


def test_the_try_with_the_highest_last_reward_goes_on_and_is_reported():
    log, shown = Log([]), []
    train = trained([0.1, 0.3, 0.2], log)
    position = best_try(started, train, log.hooks(), 3, lambda name, row: shown.append(name))
    assert position.state.index == 1
    assert [row["reward"] for row in log.rows] == [8.0, 0.3]
    assert shown == ["try 1", "try 1", "try 2", "try 2", "try 3", "try 3"]


def test_an_interrupted_run_starts_its_tries_again():
    log = Log([])
    train = trained([0.1, 0.3, 0.2], log, stop_at=1)
    position = best_try(started, train, log.hooks(), 3, lambda *_: None)
    assert (position.state.index, position.chunks, log.rows) == (0, 0, [])


@pytest.mark.slow
def test_a_run_with_tries_is_that_of_its_best_try_and_resumes(tmp_path):
    keys = [*TINY, *TINY_LEARNER["shac"], "run.devices=1"]
    tries = "run.tries={number: 2, part: 0.5}"
    plain = quadjax.train(load_config("e2e_shac", keys), tmp_path / "plain", progress=False)
    config = load_config("e2e_shac", [*keys, tries])
    done = quadjax.train(config, tmp_path / "tries", progress=False)
    own, other = done.metrics["reward"], plain.metrics["reward"]
    assert done.metrics["steps"].tolist() == plain.metrics["steps"].tolist()
    half = len(own) // 2
    assert own[half - 1] >= other[half - 1]  # try 1 is the run without tries
    stopped = quadjax.train(config, tmp_path / "stop", progress=False, enough=lambda row: True)
    assert not stopped.finished
    quadjax.train(config, tmp_path / "stop", resume=True, progress=False)
    np.testing.assert_array_equal(read_metrics(tmp_path / "stop/metrics.csv")["reward"], own)
