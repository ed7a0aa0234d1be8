"""Schedules of any number of a run."""

import logging

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct

from quadjax.core.errors import InputError
from quadjax.learners.schedules import Climb, make_schedule, schedule_learner, with_schedules
from quadjax.learners.section import Curriculum, Schedule
from quadjax.learners.state import Learner

STEPS = 64  # of an update


@struct.dataclass
class State:
    update: jax.Array


def tree(rate=1.0, gain=2.0, count=3, extra=None):
    hyper = {"rate": jnp.float32(rate)}
    params = {"gain": jnp.array([gain, 10.0 * gain]), "count": jnp.int32(count), "extra": extra}
    return hyper, params


def plain_learner():
    """A learner whose metrics are the numbers that it is given."""

    def init(hyper, params, key):
        return {"rate": hyper["rate"], "gain": params["gain"]}

    def update(hyper, params, state):
        return State(state.update + 1), {"rate": hyper["rate"], "gain": params["gain"]}

    return Learner(init, update, tree()[0], STEPS, 1)


def numbers(learner, update):
    found = learner.update(learner.hyper, tree()[1], State(jnp.int32(update)))[1]
    return float(found["rate"]), found["gain"].tolist()


def test_leaves_that_differ_are_interpolated_in_environment_steps():
    schedule = make_schedule("rate", [2 * STEPS, 4 * STEPS], [tree(rate=1), tree(rate=5)], STEPS)
    learner = with_schedules(plain_learner(), {"rate": schedule})
    rates = [numbers(learner, update)[0] for update in (0, 2, 3, 4, 5, 10**9)]
    assert rates == [1, 1, 3, 5, 5, 5]
    assert numbers(learner, 3)[1] == [2, 20]


def test_several_knots_and_several_schedules():
    gains = [tree(gain=g) for g in (0.0, 4.0, 4.0, 1.0)]
    gain = make_schedule("gain", [0, 4 * STEPS, 8 * STEPS, 8 * STEPS], gains, STEPS)
    rate = make_schedule("rate", [0, STEPS], [tree(rate=8), tree(rate=0)], STEPS)
    learner = with_schedules(plain_learner(), {"gain": gain, "rate": rate})
    found = {update: numbers(learner, update) for update in (0, 1, 2, 4, 7, 8, 9)}
    assert [g[0] for _, g in found.values()] == [0, 1, 2, 4, 4, 1, 1]
    assert all(g[1] == 10 * g[0] for _, g in found.values())
    assert [r for r, _ in found.values()] == [8, 0, 0, 0, 0, 0, 0]
    begin = learner.init(learner.hyper, tree()[1], None)
    assert (float(begin["rate"]), begin["gain"].tolist()) == (8, [0, 0])


def test_other_numbers_of_a_schedule_compile_nothing(caplog):
    def scheduled(first, last, until):
        trees = [tree(rate=first), tree(rate=last)]
        return with_schedules(
            plain_learner(), {"rate": make_schedule("rate", [0, until], trees, STEPS)}
        )

    program = jax.jit(scheduled(1, 2, STEPS).update)
    with jax.log_compiles(), caplog.at_level(logging.WARNING, logger="jax"):
        found = [
            float(program(scheduled(*case).hyper, tree()[1], State(jnp.int32(4)))[1]["rate"])
            for case in ((1, 2, 8 * STEPS), (4, 0, 8 * STEPS), (1, 2, STEPS))
        ]
    assert found == [1.5, 2.0, 2.0]
    compiled = [r for r in caplog.records if "Finished XLA compilation" in r.getMessage()]
    assert sum("jit(update)" in r.getMessage() for r in compiled) == 1


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ({}, "schedules: the.key has no effect: it changes no number of this run"),
        ({"count": 4}, "it changes numbers that are whole or infinite"),
        ({"rate": np.inf}, "it changes numbers that are whole or infinite"),
        ({"extra": jnp.ones(())}, "it changes the program, not only numbers"),
        ({"gain": jnp.ones(3)}, "it changes the program, not only numbers"),
    ],
)
def test_what_cannot_be_scheduled_is_one_line(second, message):
    with pytest.raises(InputError, match="the.key") as caught:
        make_schedule("the.key", [0, 1], [tree(), tree(**second)], STEPS)
    assert message in str(caught.value)


def test_two_schedules_of_one_number_are_refused():
    one = make_schedule("first", [0, 1], [tree(gain=1), tree(gain=2)], STEPS)
    with pytest.raises(InputError, match="first and second change the same number"):
        with_schedules(plain_learner(), {"first": one, "second": one})


def test_no_schedules_leave_the_learner_as_it_is():
    learner = plain_learner()
    assert with_schedules(learner, {}) is learner
    assert np.array_equal(numbers(learner, 5)[1], [2, 20])


@struct.dataclass
class Leveled:
    """A train state with a level."""

    update: jax.Array
    level: jax.Array | None = None


def share_learner(name="pass_rate"):
    """A learner whose share of completed parts is its gain."""

    def init(hyper, params, key):
        return Leveled(jnp.int32(0))

    def update(hyper, params, state):
        metrics = {"rate": hyper["rate"], name: params["gain"][0]}
        return Leveled(state.update + 1), metrics

    return Learner(init, update, tree()[0], STEPS, 1)


def test_a_level_rises_with_the_share_and_falls_without_it():
    """Half the updates of a run from level 0 to 1; the number follows the level, not the steps."""
    curriculum = Curriculum(pass_rate=0.8, duration=0.5)
    learner = schedule_learner(
        share_learner(),
        {"rate": Schedule(linear=(1.0, 5.0), by="pass_rate")},
        lambda key, value: tree(rate=value),
        8 * STEPS,
        8 * STEPS,
        curriculum,
    )
    state, rates = learner.init(learner.hyper, tree()[1], jax.random.key(0)), []
    for share in (0.5, 0.9, 0.8, 0.9, 0.9, 0.9, 0.7, 0.9):
        state, metrics = learner.update(learner.hyper, tree(gain=share)[1], state)
        rates.append(float(metrics["rate"]))
    assert rates == [1, 1, 2, 3, 4, 5, 5, 4]
    assert float(metrics["level"]) == float(state.level) == 1.0


def test_a_level_needs_a_learner_that_reports_the_share():
    schedule = make_schedule("rate", [0, 1], [tree(rate=1), tree(rate=5)], STEPS, by_level=True)
    climb = Climb(jnp.float32(0.5), jnp.float32(0.1))
    learner = with_schedules(share_learner("other"), {"rate": schedule}, climb)
    state = learner.init(learner.hyper, tree()[1], jax.random.key(0))
    with pytest.raises(InputError, match="reports no metric pass_rate"):
        learner.update(learner.hyper, tree()[1], state)
