"""Checkpoints that cannot be written or read are one line."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.learners.loop import Progress
from quadjax.learners.state import ActorCritic
from quadjax.training.checkpoint import Checkpoints, RunState


def run_state(steps):
    parameters = ActorCritic(jnp.ones(3), jnp.ones(3), jnp.zeros(4))
    state = {"params": jnp.arange(3.0), "key": jax.random.key(7)}
    return RunState(state=state, best=parameters, steps=steps, best_score=15.0, best_steps=100)


def test_the_best_policy_is_the_latest_of_equal_scores():
    found, kept = RunState(state=None, best="none"), []
    for chunk, score in enumerate([np.inf, 15.0, 14.0, 14.0, 16.0, np.inf]):
        state = types.SimpleNamespace(evaluated=str(chunk))
        progress = Progress(state, 100 * (chunk + 1), {}, 1.0)
        found = found.after(progress, score, 1.0)
        kept.append((found.best, found.best_score, found.best_steps))
    assert kept[:3] == [("0", np.inf, 100), ("1", 15.0, 200), ("2", 14.0, 300)]
    assert kept[3:] == [("3", 14.0, 400)] * 3


def test_a_position_is_restored(tmp_path):
    checkpoints = Checkpoints(tmp_path)
    assert not checkpoints.exists
    checkpoints.save(run_state(2))
    checkpoints.save(run_state(3))
    found = checkpoints.restore(run_state(0))
    assert (found.steps, found.best_score, found.best_steps) == (3, 15.0, 100)
    assert jnp.array_equal(found.state["params"], jnp.arange(3.0))
    assert jax.random.key_data(found.state["key"]).tolist() == [0, 7]
    assert [path.name for path in (tmp_path / "latest").iterdir() if path.name.isdigit()] == ["3"]
    checkpoints.close()


def test_a_full_disk_is_one_line_and_the_last_checkpoint_stays(tmp_path, monkeypatch):
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(run_state(1))

    def full(*arguments, **named):
        raise ValueError("RESOURCE_EXHAUSTED: No space left on device\nmany lines")

    monkeypatch.setattr(type(checkpoints._manager), "save", full)
    with pytest.raises(InputError, match="cannot be written .*No space left") as caught:
        checkpoints.save(run_state(2))
    assert "\n" not in str(caught.value)
    monkeypatch.undo()
    assert checkpoints.restore(run_state(0)).steps == 1
    checkpoints.close()
