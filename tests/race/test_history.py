"""Fields of the observation as they were in earlier steps."""

import functools

import jax
import numpy as np
import pytest

from quadjax.config.race import choices_of
from quadjax.core.errors import InputError
from quadjax.race import environment
from quadjax.race.layout import push_past
from quadjax.race.step import Step
from tests.promotion import QUICK
from tests.race.support import compiled_reset, make_config, make_race

FIELDS = ("velocity", "attitude", "rates", "rpm", "last_action")
HISTORY = f"observation.history={{fields: [{', '.join(FIELDS)}], steps: 3, every: 2}}"
STEPS = 9


@pytest.fixture(scope="module")
def flown():
    """A short flight with random actions through a gate: its race, states and observations."""
    choices, params = make_race(HISTORY, "start.gate=random")
    step, see = (
        jax.jit(functools.partial(function, choices), compiler_options=QUICK)
        for function in (environment.transition, environment.observe)
    )
    state = jax.tree.map(lambda x: x[0], compiled_reset(choices)(params, jax.random.key(0), 1))
    actions = np.random.default_rng(0).uniform(-1, 1, (STEPS, 4)).astype(np.float32)
    states = [state]
    for number, action in enumerate(actions):
        state, *_ = step(params, state, action)
        if number == 3:  # the earlier states are then seen from another gate
            state = state.replace(target=(state.target + 1) % 4)
        states.append(state)
    return choices, states, [np.asarray(see(params, each)) for each in states], see, params


def test_the_history_is_the_earlier_state_seen_from_the_present_gate(flown):
    choices, states, seen, see, params = flown
    layout = choices.layout
    assert layout.size == 24 + 3 * (3 + 3 + 3 + 4 + 4)
    for now, state in enumerate(states):
        for lag in (2, 4, 6):
            then = states[max(now - lag, 0)]
            plain = np.asarray(see(params, state.replace(drone=then.drone)))
            for name in FIELDS[:-1]:
                found = seen[now][layout.slice(f"{name}@{lag}")]
                np.testing.assert_array_equal(found, plain[layout.slice(name)], f"{name} {now}")
            given = seen[now][layout.slice(f"last_action@{lag}")]
            np.testing.assert_allclose(given, np.stack(then.action), atol=1e-6)
    turned = seen[4][layout.slice("velocity@2")] - seen[2][layout.slice("velocity")]
    assert np.abs(turned).max() > 0.1


def test_gradients_flow_through_the_history(flown):
    choices, states, _, _, params = flown
    state = states[0]

    def seen(roll_rate):
        drone = state.drone.replace(rates=state.drone.rates.replace(x=roll_rate))
        past = push_past(push_past(state.past, state.replace(drone=drone)), state)
        seen = Step(choices.model, params, state.replace(past=past), None)
        return choices.layout["rates@2"].numbers(seen)[0]

    assert jax.grad(seen)(0.3) == 1.0


REFUSED = {
    "{}": r"fields is \[\], allowed: one or more of position, velocity, ",
    "{fields: [rpm, actuators]}": "each once",
    "{fields: [rpm], steps: 16, every: 5}": "steps is 16, allowed: at most 12",
}


def test_names_and_impossible_histories():
    for history, message in REFUSED.items():
        with pytest.raises(InputError, match=message):
            make_config(f"observation.history={history}")
    for vehicle, name in (("bebop1", "rpm"), ("5inch", "rotor_speed")):  # of any model
        config = make_config(
            f"vehicle={vehicle}", "observation.history={fields: [actuators], steps: 1}"
        )
        assert choices_of(config).layout.names[-1] == f"{name}@4"
