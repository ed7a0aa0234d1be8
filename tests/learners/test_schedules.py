"""Schedules of any number of a run."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from quadjax.core.errors import InputError
from quadjax.learners.loop import Plan
from quadjax.learners.schedules import Curriculum, Schedule, make_schedule, schedule_learner
from quadjax.learners.state import Learner

STEPS = 64  # of an update


class State(struct.PyTreeNode):
    """A train state with a level."""

    update: jax.Array
    level: jax.Array | None = None


def tree(rate=1.0, gain=2.0, count=3, extra=None):
    hyper = {"rate": jnp.float32(rate)}
    params = {"gain": jnp.array([gain, 10.0 * gain]), "count": jnp.int32(count), "extra": extra}
    return hyper, params


def scheduled(schedules, updates=10, curriculum=None, share="pass_rate"):
    """A learner whose metrics are its numbers, with schedules of the rate and of the gain."""

    def init(hyper, params, key):
        return State(jnp.int32(0)) if key is not None else (hyper["rate"], params["gain"])

    def update(hyper, params, state):
        metrics = {"rate": hyper["rate"], "gain": params["gain"], share: params["gain"][0]}
        return state.replace(update=state.update + 1), metrics

    return schedule_learner(
        Learner(init, update, tree()[0], STEPS),
        {key: Schedule(**numbers) for key, numbers in schedules.items()},
        lambda key, value: tree() if value is None else tree(**{key: value}),
        Plan(updates, 1, STEPS),
        updates * STEPS,
        curriculum,
    )


def numbers(learner, update):
    found = learner.update(learner.hyper, tree()[1], State(jnp.int32(update)))[1]
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
    learner = scheduled({"gain": schedule})
    for update, value in values.items():
        rate, gain = numbers(learner, update)
        np.testing.assert_allclose(gain, [value, 10 * value], atol=1e-5)
        assert rate == 1.0  # which has no schedule


def test_a_run_begins_with_the_first_values():
    learner = scheduled({"rate": {"linear": (8.0, 0.0)}, "gain": {"linear": (0.0, 4.0)}})
    rate, gain = learner.init(learner.hyper, tree()[1], None)
    assert (float(rate), gain.tolist()) == (8, [0, 0])


def test_other_numbers_of_a_schedule_compile_nothing():
    def learner(first, last, until):
        return scheduled({"rate": {"linear": (first, last), "until": until}})

    program = jax.jit(chex.assert_max_traces(learner(1.0, 2.0, STEPS).update, n=1))
    cases = ((1.0, 2.0, 8 * STEPS), (4.0, 0.0, 8 * STEPS), (1.0, 2.0, STEPS))
    found = [
        float(program(learner(*case).hyper, tree()[1], State(jnp.int32(4)))[1]["rate"])
        for case in cases
    ]
    assert found == [1.5, 2.0, 2.0]


def test_what_cannot_be_scheduled_is_one_line():
    for second, message in (
        ({}, "schedules: the.key has no effect: it changes no number of this run"),
        ({"count": 4}, "the.key .* it changes numbers that are whole or infinite"),
        ({"extra": np.ones(())}, "the.key .* it changes the program, not only numbers"),
    ):
        with pytest.raises(InputError, match=message):
            make_schedule("the.key", np.arange(2.0), [tree(), tree(**second)])
    schedules = {"first": Schedule(linear=(1, 2)), "second": Schedule(linear=(1, 3))}
    plain = Learner(None, None, tree()[0], STEPS)
    with pytest.raises(InputError, match="first and second change the same number"):
        schedule_learner(
            plain, schedules, lambda _, gain: tree(gain=gain), Plan(1, 1, STEPS), STEPS
        )


LEVEL = {"rate": {"linear": (1.0, 5.0), "by": "pass_rate"}}


def test_a_level_rises_with_the_share_and_falls_without_it():
    """Half the updates of a run from level 0 to 1; the number follows the level, not the steps."""
    learner = scheduled(LEVEL, 8, Curriculum(pass_rate=0.8, duration=0.5))
    state, rates = learner.init(learner.hyper, tree()[1], jax.random.key(0)), []
    for share in (0.5, 0.9, 0.8, 0.9, 0.9, 0.9, 0.7, 0.9):
        state, metrics = learner.update(learner.hyper, tree(gain=share)[1], state)
        rates.append(float(metrics["rate"]))
    assert rates == [1, 1, 2, 3, 4, 5, 5, 4]
    assert float(metrics["level"]) == float(state.level) == 1.0


def test_a_level_needs_a_learner_that_reports_the_share():
    learner = scheduled(LEVEL, share="other")
    state = learner.init(learner.hyper, tree()[1], jax.random.key(0))
    with pytest.raises(InputError, match="reports no metric pass_rate"):
        learner.update(learner.hyper, tree()[1], state)
