"""Reward terms, rules and observation fields of one's own."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.vectors import safe_norm
from quadjax.race.laps import fly_laps, fly_race, lap_length, starting_states, time_limit
from quadjax.race.layout import Field, Layout, make_layout
from quadjax.race.result import Laps
from quadjax.vehicle import rate
from quadjax.vehicle.motor import MODEL
from quadjax.vehicle.protocol import Signal
from tests import reference as ref
from tests.race.support import compiled_observe, level, make_race, race_state, step, track_of


def speed(context):
    return safe_norm(context.velocity)


def squared_action(context):
    return context.time_step * jnp.sum(context.action**2)


def ceiling(context):
    return context.position.z < -2.0


def test_terms_are_added_in_their_weights():
    choices, params = make_race()
    rows = level(ref.GATES[3], [1.0, 2.0, -2.0])
    _, plain, _ = step((choices, params), rows, action=0.5)
    own = dataclasses.replace(choices, terms=(speed, squared_action))
    weights = params.replace(term_weights=(jnp.float32(0.5), jnp.float32(-2.0)))
    state, value, _ = step((own, weights), rows, action=0.5)
    after = np.linalg.norm([float(x[0]) for x in state.drone.velocity.components()])
    assert float(value[0] - plain[0]) == pytest.approx(0.5 * after - 2.0 * 0.01, rel=1e-4)


def test_a_rule_ends_the_episode_as_a_collision_does():
    choices, params = make_race()
    own = dataclasses.replace(choices, rules=(ceiling,))
    rows = level([ref.GATES[3] + [0, 0, -0.4], ref.GATES[3] + [0, 0, -0.6]], np.zeros(3))
    _, value, outcome = step((own, params), rows)
    np.testing.assert_array_equal(outcome.extra_rule, [False, True])
    np.testing.assert_array_equal(outcome.terminated, [False, True])
    assert float(value[1]) == -10.0
    assert not np.any(step((choices, params), rows)[2].terminated)


def test_a_rule_applies_to_timed_laps():
    choices, params = make_race()
    own = dataclasses.replace(choices, rules=(ceiling,))

    def climb(policy, observation, noise):
        return jnp.ones(4)

    laps, _ = fly_laps(own, params, climb, None, jax.random.key(0), 1, 1)
    assert laps.crashes == ("ended by an extra rule",)


def five_commands(constants):
    low, high = rate.command_range(constants)
    return (low, jnp.float32(0.0)), (high, jnp.float32(1.0))


FIVE_COMMANDS = dataclasses.replace(
    rate.MODEL,
    commands=(*rate.MODEL.commands, Signal("flap", 1, "")),
    command_range=five_commands,
    derivative=lambda params, state, command, call: rate.derivative(
        params, state, command[0], call
    ),
)


def test_timed_laps_of_a_model_with_five_commands():
    choices, params = make_race("vehicle.model=tests.race.test_extensions:FIVE_COMMANDS")
    states = starting_states(choices, params, jax.random.key(0), 2, from_hover=True)

    def actor(policy, observation, noise):
        return jnp.clip(noise, -1.0, 1.0)

    _, kept = fly_race(choices, actor, 1, 3, True, params, None, states, jax.random.key(1))
    assert kept.command.shape == (3, 5, 2)
    assert np.all((kept.command[:, 4] >= 0.0) & (kept.command[:, 4] <= 1.0))
    assert np.unique(kept.command[:, 4]).size > 1


def height(view):
    return (-view.model.position(view.drone).z,)


HEIGHT = Field("height", 1, "m", "", value=height)


def test_an_own_field_is_appended_to_the_observation():
    choices, params = make_race()
    own = dataclasses.replace(choices, layout=make_layout(MODEL, extra=(HEIGHT,)))
    state = race_state("motor", level(ref.GATES[:2], np.ones(3)), [0, 1])
    plain, more = (np.asarray(compiled_observe(c)(params, state)) for c in (choices, own))
    np.testing.assert_array_equal(more[:, :24], plain)
    np.testing.assert_array_equal(more[:, own.layout.slice("height")], [[1.5], [1.5]])
    assert own.layout.size == 25 and own.layout.labels[-1] == "height"


def test_an_own_field_of_another_size_is_refused():
    choices, params = make_race()
    wrong = dataclasses.replace(HEIGHT, size=2)
    own = dataclasses.replace(choices, layout=make_layout(MODEL, extra=(wrong,)))
    with pytest.raises(InputError, match="'height' gives 1 numbers, expected 2 numbers .its size."):
        compiled_observe(own)(params, race_state("motor", level(ref.GATES[:1], np.ones(3))))
    with pytest.raises(InputError, match="same name"):
        make_layout(MODEL, extra=(HEIGHT, HEIGHT))


def test_own_objects_are_named_in_the_config():
    own = "tests.race.test_extensions"
    choices, params = make_race(
        f"reward.terms={{{own}:speed: 0.5}}",
        f"rules.extra=[{own}:ceiling]",
        f"observation.extra=[{own}:HEIGHT]",
    )
    assert (choices.terms, choices.rules, choices.layout.fields[-1]) == (
        (speed,),
        (ceiling,),
        HEIGHT,
    )
    assert [float(weight) for weight in params.term_weights] == [0.5]
    with pytest.raises(InputError, match=r"observation.extra: .*:height is .*expected a Field"):
        make_race(f"observation.extra=[{own}:height]")
    with pytest.raises(InputError, match=r"rules.extra: .*:HEIGHT is .*expected a function"):
        make_race(f"rules.extra=[{own}:HEIGHT]")


@pytest.mark.parametrize("span", [(None, 0.0), (2.0, 2.0)])
def test_a_field_whose_range_has_no_width_gives_zero(span):
    choices, params = make_race()
    field = dataclasses.replace(HEIGHT, scale=lambda model, params: span)
    own = dataclasses.replace(choices, layout=make_layout(MODEL, extra=(field,)))
    state = race_state("motor", level(ref.GATES[:2], np.ones(3)), [0, 1])
    shown = np.asarray(compiled_observe(own)(params, state))
    np.testing.assert_array_equal(shown[:, own.layout.slice("height")], 0.0)


def test_a_layout_survives_its_file():
    choices, params = make_race("disturbance.moment_x=0.03")
    layout = choices.layout.with_spans(choices.model, params)
    back = Layout.from_meta(layout.to_meta(), "file: layout")
    assert back.labels == layout.labels and back["rpm"].span == ((3000.0, 11000.0),) * 4
    assert back["moment_ext"].span[0] == pytest.approx((-0.03, 0.03))
    assert back["position"].span is None and back.slice("rpm") == slice(12, 16)
    for changes in ({"size": 0}, {"size": 2.5}, {"name": 3}, {"span": [[1, 2]]}, {"range": "x"}):
        broken = [{**item, **(changes if item["name"] == "rpm" else {})} for item in back.to_meta()]
        with pytest.raises(InputError, match=r"layout\[4\]"):
            Layout.from_meta(broken, "layout")


def test_a_crash_never_improves_the_score():
    """On a track of four times the length, a lap may take longer than 8 s."""
    track = track_of(4.0 * ref.GATES, ref.GATE_YAW)
    assert lap_length(track) == pytest.approx(56.0)
    limit = time_limit(track, 6)
    slow = np.full((4, 6), 10.0)
    crashed = slow.copy()
    crashed[0, 1:] = np.nan
    finished = Laps(slow, ("",) * 4, slow.sum(1), limit)
    one_less = Laps(crashed, ("hit a gate", "", "", ""), slow.sum(1), limit)
    assert finished.score == 60.0 and one_less.score > finished.score
    assert time_limit(track_of(ref.GATES, ref.GATE_YAW), 6) == 48.0
