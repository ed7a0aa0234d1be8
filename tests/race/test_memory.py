"""Memories of a race: of the user's own terms and fields; what is wrong with one is one line."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax import Memory, ObservedField
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.plant import flight as onboard_flight
from quadjax.plant.config import load_plant_config
from quadjax.plant.flights import plan_race
from quadjax.race.layout import Layout
from quadjax.race.memory import DISTURBANCE, clipped_action, memories_of
from quadjax.training.build import untrained_policy
from tests.race.support import make_race

OVERRIDES = (
    f"reward.terms={{{__name__}:term: 2.0}}",
    f"observation.extra=[{__name__}:COUNTER]",
    "observation.last_action=true",
)


class Counter(Memory):
    """Steps, and the sum of the first number of all actions."""

    name = "counter"

    def begin(self, model, params, state):
        return jnp.zeros((), jnp.int32), 0.0 * state.drone.position.x

    def advance(self, value, step):
        return value[0] + 1, value[1] + clipped_action(step.action)[0]


def term(step):
    """The number of steps before this one."""
    return step.memories["counter"][0].astype(jnp.float32)


def observed(step):
    return step.memories["counter"][1:]


term.memory = MEMORY = Counter()
COUNTER = ObservedField("counter", 1, "", "", value=observed, memory=MEMORY)


def test_a_term_and_a_field_share_a_memory():
    environment, params = make_race(*OVERRIDES)
    _, plain = make_race("observation.last_action=true")
    assert [x.name for x in memories_of(environment, params)] == ["last_action", "counter"]
    state = environment.reset(params, jax.random.key(0))
    step = jax.jit(environment.step)
    for count, action in enumerate((0.5, -3.0, 0.25)):
        same = dataclasses.replace(environment, user_terms=())
        _, without, *_ = jax.jit(same.step)(plain, state, jnp.full(4, action))
        state, value, *_ = step(params, state, jnp.full(4, action))
        assert float(value - without) == pytest.approx(2.0 * count, abs=1e-5)
    assert float(environment.observe(params, state)[-1]) == pytest.approx(0.5 - 1.0 + 0.25)
    np.testing.assert_allclose(state.memories["last_action"], 0.25)


def test_a_memory_begins_with_every_episode():
    environment, params = make_race(*OVERRIDES, "start.race=0.5")
    starts = jax.vmap(environment.reset, (None, 0))(params, jax.random.split(jax.random.key(0), 9))
    assert not starts.memories["counter"][0].any()


def test_the_published_race_has_no_memory():
    environment, params = make_race()
    assert environment.reset(params, jax.random.key(0)).memories == {}
    environment, params = make_race("observation.disturbance=estimated")
    assert set(environment.reset(params, jax.random.key(0)).memories) == {DISTURBANCE}


class Divides(Counter):
    def begin(self, model, params, state):
        return 1 / 0


class Grows(Counter):
    def advance(self, value, step):
        return jnp.zeros(3)


class Named(Memory):
    name = "counter"


class Begins(Named):
    def begin(self, model, params, state):
        return jnp.zeros(())


class Empty(Counter):
    def begin(self, model, params, state):
        return None


class Same(Counter):
    name = "last_action"


WRONG = {
    "memory 'counter': ZeroDivisionError: division by zero": Divides(),
    r"memory .counter.: advance gives float32 \(3,\), expected .int32 \(\), float32 ": Grows(),
    r"term: Named has no begin\(model, params, state\)": Named(),
    r"term: Begins has no advance\(value, step\)": Begins(),
    "memory 'counter': begin gives None, allowed: arrays": Empty(),
    "term: LookupError: no memory 'counter'; this race has: none; set the attrib": None,
    "term: another memory is named 'last_action', allowed: one object": Same(),
    "term: memory is 3, allowed: a quadjax.Memory with a name": 3,
    "term: memory is <.*>, allowed: a quadjax.Memory with a name": Memory(),
}


@pytest.mark.parametrize("message", WRONG)
def test_a_wrong_memory_is_one_line(message, monkeypatch):
    monkeypatch.setattr(term, "memory", WRONG[message])
    environment, params = make_race(f"reward.terms={{{__name__}:term: 2.0}}")
    with pytest.raises(InputError, match=message):
        state = environment.reset(params, jax.random.key(0))
        environment.step(params, state, jnp.zeros(4))


@dataclasses.dataclass
class Unhashable(Counter):
    """A memory that is a plain dataclass."""

    rate: float = 0.5


def test_a_race_with_a_memory_can_be_static(monkeypatch):
    """Also where the memory has no hash."""
    monkeypatch.setattr(term, "memory", memory := Unhashable())
    environment, params = make_race(f"reward.terms={{{__name__}:term: 2.0}}")
    field = dataclasses.replace(COUNTER, memory=memory)
    layout = Layout((*environment.layout.fields, field))
    environment = dataclasses.replace(environment, layout=layout)
    assert hash(environment)
    assert "counter" in environment.reset(params, jax.random.key(0)).memories


@pytest.mark.slow  # compiles the plant
def test_on_a_plant_a_field_remembers_what_is_estimated_and_terms_are_left_out(monkeypatch):
    config = load_config("e2e", OVERRIDES)
    monkeypatch.setattr(term, "memory", Divides())
    plan = plan_race(config, load_plant_config("exact"), untrained_policy(config), runs=1)
    drones = onboard_flight.begin(plan, jax.random.key(0))
    drones, _ = onboard_flight.advance(plan, 3, drones, jax.random.key(1))
    assert int(drones.race.state.memories["counter"][0][0]) == 3
