"""Schedules of any number of a run."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from quadjax.core.errors import InputError
from quadjax.core.traced import as_leaves
from quadjax.learners.learner import Learner
from quadjax.learners.loop import Plan
from quadjax.learners.schedules import Curriculum, Schedule, Training
from quadjax.learners.state import Task
from tests.learners.probes import ENVIRONMENT, NETWORK

STEPS = 64  # of an update


class State(struct.PyTreeNode):
    """A train state with a level, and the numbers with which the run began."""

    update: jax.Array
    level: jax.Array | None = None
    first: tuple = ()


class Reporting(Learner):
    """Its metrics are its numbers and those of the environment."""

    rate: float = 1.0
    share: str = "pass_rate"

    def init(self, task, key):
        return State(jnp.int32(0), first=(self.rate, task.env_params["gain"]))

    def update(self, task, state):
        gain = task.env_params["gain"]
        metrics = {"rate": self.rate, "gain": gain, self.share: gain[0]}
        return state.replace(update=state.update + 1), metrics


def params(gain=2.0):
    return {"gain": jnp.array([gain, gain]), "count": jnp.int32(3), "far": jnp.inf}


def scheduled(schedules, updates=10, curriculum=None, share="pass_rate", paths=None):
    """Training of the learner above, with schedules of the rate and of the gain."""
    task = Task.of(ENVIRONMENT, NETWORK, params())
    return Training(as_leaves(Reporting(share=share)), task).with_schedules(
        {key: Schedule(**numbers) for key, numbers in schedules.items()},
        paths or (lambda key: ("learner.rate" if key == "rate" else f"params.{key}",)),
        Plan(updates, 1, STEPS),
        updates * STEPS,
        curriculum,
    )


def numbers(training, update):
    found = training.update(State(jnp.int32(update)))[1]
    return float(found["rate"]), found["gain"].tolist()


VALUES = {  # a schedule of the gain, which is 2, and its values after numbers of updates of ten
    "two knots": ({"linear": (1.0, 5.0), "start": 128, "until": 256}, {0: 1, 2: 1, 3: 3, 5: 5}),
    "its last value stays": ({"linear": (1.0, 5.0)}, {10: 5, 10**9: 5}),
    "several knots": ({"linear": (0.0, 4.0, "value")}, {0: 0, 2: 1.6, 5: 4, 8: 2.8, 10: 2}),
    "a jump": ({"linear": (2.0, 6.0), "start": 256, "until": 256}, {0: 2, 3: 2, 4: 6, 5: 6}),
}


@pytest.mark.parametrize("case", VALUES)
def test_the_values_of_a_schedule(case):
    schedule, values = VALUES[case]
    training = scheduled({"gain": schedule})
    for update, value in values.items():
        rate, gain = numbers(training, update)
        np.testing.assert_allclose(gain, [value, value], atol=1e-5)
        assert rate == 1.0  # which has no schedule


def test_a_run_begins_with_the_first_values():
    training = scheduled({"rate": {"linear": (8.0, 0.0)}, "gain": {"linear": (0.0, 4.0)}})
    rate, gain = training.init(jax.random.key(0)).first
    assert (float(rate), gain.tolist()) == (8, [0, 0])


def test_other_numbers_of_a_schedule_compile_nothing():
    def training(first, last, until):
        return scheduled({"rate": {"linear": (first, last), "until": until}})

    program = jax.jit(chex.assert_max_traces(Training.update, n=1))
    cases = ((1.0, 2.0, 8 * STEPS), (4.0, 0.0, 8 * STEPS), (1.0, 2.0, STEPS))
    found = [float(program(training(*case), State(jnp.int32(4)))[1]["rate"]) for case in cases]
    assert found == [1.5, 2.0, 2.0]


def test_what_cannot_be_scheduled_is_one_line():
    for key, hint in (("gains", "; did you mean gain"), ("count", ""), ("far", "")):
        message = f"schedules: {key} cannot be scheduled, allowed: a finite .* params{hint}"
        with pytest.raises(InputError, match=message):
            scheduled({key: {"linear": (1, 2)}})
    both = {"first": {"linear": (1, 2)}, "second": {"linear": (1, 3)}}
    with pytest.raises(InputError, match="first and second change the same number"):
        scheduled(both, paths=lambda key: ("params.gain",))


LEVEL = {"rate": {"linear": (1.0, 5.0), "by": "pass_rate"}}


def test_a_level_rises_with_the_share_and_falls_without_it():
    """Half the updates of a run from level 0 to 1; the number follows the level, not the steps."""
    training = scheduled(LEVEL, 8, Curriculum(pass_rate=0.8, duration=0.5))
    state, rates = training.init(jax.random.key(0)), []
    for share in (0.5, 0.9, 0.8, 0.9, 0.9, 0.9, 0.7, 0.9):
        task = training.task.replace(env_params=params(share))
        state, metrics = training.replace(task=task).update(state)
        rates.append(float(metrics["rate"]))
    assert rates == [1, 1, 2, 3, 4, 5, 5, 4]
    assert float(metrics["level"]) == float(state.level) == 1.0


def test_a_level_needs_a_learner_that_reports_the_share():
    training = scheduled(LEVEL, share="other")
    with pytest.raises(InputError, match="reports no metric pass_rate"):
        training.update(training.init(jax.random.key(0)))
