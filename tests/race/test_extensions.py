"""Reward terms, rules and observation fields of one's own."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.vectors import safe_norm
from quadjax.race.draws import Randomization
from quadjax.race.laps import Laps, fly_race, lap_length, starting_states, time_limit
from quadjax.race.layout import Layout, ObservedField
from quadjax.race.observations import make_layout
from quadjax.race.rules import terminations_of
from quadjax.vehicle.constants import constant
from quadjax.vehicle.motor import MODEL
from quadjax.vehicle.protocol import Signal
from quadjax.vehicle.rate import Rate, RateConstants
from tests import reference as ref
from tests.race.support import (
    HOVER,
    by_rows,
    compiled_observe,
    first_score,
    level,
    make_race,
    race_state,
    step,
    track_of,
)


def speed(context):
    return safe_norm(context.velocity)


def squared_action(context):
    return context.time_step * jnp.sum(context.action**2)


def ceiling(context):
    return context.position.z < -2.0


@pytest.fixture(scope="module")
def races():
    """The published race, and one with two terms of the reward and a rule."""
    environment, params = make_race()
    terms = (("speed", speed), ("squared", squared_action))
    own = dataclasses.replace(environment, user_terms=terms, user_rules=(("ceiling", ceiling),))
    weights = {"speed": jnp.float32(0.5), "squared": jnp.float32(-2.0)}
    reward = params.reward.replace(terms=weights)
    return (environment, params), (own, params.replace(reward=reward))


def test_terms_are_added_in_their_weights(races):
    rows = level(ref.GATES[3], [1.0, 2.0, -2.0])
    (_, plain, _), (state, value, _) = (step(race, rows, action=0.5) for race in races)
    after = np.linalg.norm([float(x[0]) for x in state.drone.velocity.components()])
    assert float(value[0] - plain[0]) == pytest.approx(0.5 * after - 2.0 * 0.01, rel=1e-4)


def test_a_rule_ends_the_episode_as_a_collision_does(races):
    rows = level([ref.GATES[3] + [0, 0, -0.4], ref.GATES[3] + [0, 0, -0.6]], np.zeros(3))
    following, value, outcome = step(races[1], rows)
    np.testing.assert_array_equal(outcome.crashes["ended by ceiling"], [False, True])
    np.testing.assert_array_equal(outcome.crashed, [False, True])
    terms = -2.0 * 0.01 * 4 * HOVER**2 + 0.5 * np.linalg.norm([*following.drone.velocity], axis=0)
    np.testing.assert_allclose(value[1], -10.0 + terms[1], atol=1e-5)
    assert not np.any(step(races[0], rows)[2].crashed)
    crashes = first_score(rows, 0, following, outcome).crash_code
    reasons = ("", *terminations_of(races[1][0].user_rules))
    assert [reasons[code] for code in crashes] == ["", "ended by ceiling"]


class FiveCommands(Rate):
    commands = (*Rate.commands, Signal("flap", 1, ""))

    def command_range(self, c):
        low, high = super().command_range(c)
        return (low, jnp.float32(0.0)), (high, jnp.float32(1.0))

    def derivative(self, params, state, command):
        return super().derivative(params, state, command[0])


FIVE_COMMANDS = FiveCommands()


def test_timed_laps_of_a_model_with_five_commands():
    environment, params = make_race("vehicle.model=tests.race.test_extensions:FIVE_COMMANDS")

    def flown(params, key):
        def actor(policy, observation, noise):
            return jnp.clip(noise, -1.0, 1.0)

        return fly_race(environment, actor, 1, 3, True, params, None, start(params, key), key)

    start = functools.partial(starting_states, environment, runs=2, from_hover=True)
    _, recorded = jax.eval_shape(flown, params, jax.random.key(1))
    assert recorded.command.shape == (3, 5, 2)
    command = by_rows(lambda race, action: environment.command(race, action))
    actions = np.random.default_rng(0).uniform(-1, 1, (20, 5)).astype(np.float32)
    (_, flap) = command(params, actions)
    np.testing.assert_allclose(flap, 0.5 * (actions[:, 4] + 1.0), atol=1e-6)


class Limited(type(MODEL)):
    def command_range(self, c):
        low, high = super().command_range(c)
        return low, jax.tree.map(lambda x: self.share * x, high)


LIMITED = Limited()


def test_a_model_of_the_user_is_traced_again():
    own = "vehicle.model=tests.race.test_extensions:LIMITED"
    state = jax.tree.map(
        lambda x: x[..., 0], race_state("motor", level(ref.GATES[3], np.zeros(3)), 0)
    )
    seen = []
    for share in (1.0, 0.5):
        object.__setattr__(LIMITED, "share", share)
        environment, params = make_race(own)
        seen.append(jax.jit(environment.observation)(params, state))
    assert np.abs(seen[0] - seen[1]).max() > 0.1


CEILING_M = [2.0]  # which the tests change between two races


def own_ceiling(step):
    return step.position.z < -CEILING_M[0]


def own_height(step):
    return (-step.position.z / CEILING_M[0],)


OWN_HEIGHT = ObservedField("own_height", 1, "", "", value=own_height)


def test_functions_of_the_user_are_traced_again():
    name = "tests.race.test_extensions"
    rows, seen = level([ref.GATES[3] + [0, 0, -1.0]], np.zeros(1)), []
    for CEILING_M[0] in (1.0, 4.0):
        race = make_race(
            f"observation.extra=[{name}:OWN_HEIGHT]", f"rules.extra=[{name}:own_ceiling]"
        )
        _, _, outcome = step(race, rows)
        observed = by_rows(race[0].observation)(race[1], race_state("motor", rows))
        seen.append(
            (float(observed[0, -1]), bool(outcome.crashes[f"ended by {name}:own_ceiling"][0]))
        )
    assert seen[0][0] == pytest.approx(4 * seen[1][0]) and [x[1] for x in seen] == [True, False]


def height(view):
    return (-view.drone.position.z,)


HEIGHT = ObservedField("height", 1, "m", "", value=height)


def test_own_fields_are_appended_to_the_observation():
    """A field whose range has no width gives zero."""
    environment, params = make_race()
    fields = [HEIGHT]
    for name, span in (("empty", (None, 0.0)), ("equal", (2.0, 2.0))):
        fields.append(dataclasses.replace(HEIGHT, name=name, scale=lambda *_, own=span: own))
    own = dataclasses.replace(environment, layout=make_layout(MODEL, extra=tuple(fields)))
    state = race_state("motor", level(ref.GATES[:2], np.ones(3)), [0, 1])
    plain, more = (compiled_observe(c)(params, state) for c in (environment, own))
    np.testing.assert_array_equal(more, np.hstack([plain, [[1.5, 0.0, 0.0]] * 2]))
    assert own.layout.slice("height") == slice(24, 25)
    assert own.layout.size == 27 and own.layout.labels[24:] == ("height", "empty", "equal")


def test_constants_of_a_group_of_ones_own_are_drawn_as_all():
    class Winged(RateConstants):
        lift: jax.Array = constant("1/m", "wing", "nonnegative")

    class Model(Rate):
        constants = Winged

    fractions = Randomization(all=0.2, drag=0.3).by_constant(Model())
    assert (fractions["lift"], fractions["d_x"], fractions["g"]) == (0.2, 0.3, 0.0)
    assert Randomization(constants={"lift": 0.1}).by_constant(Model())["lift"] == 0.1


def test_a_layout_survives_its_file_and_damage_is_one_line():
    environment, params = make_race("disturbance.moment_x=0.03")
    back = environment.layout.with_spans(environment.model, params)
    back = Layout.from_meta(back.to_meta(), "file: layout")
    assert back["rpm"].span == ((3000.0, 11000.0),) * 4 and back["position"].span is None
    assert back["moment_ext"].span[0] == pytest.approx((-0.03, 0.03))
    for changes in ({"size": 0}, {"size": 2.5}, {"name": 3}, {"span": [[1, 2]]}, {"range": "x"}):
        broken = [{**item, **(changes if item["name"] == "rpm" else {})} for item in back.to_meta()]
        with pytest.raises(InputError, match=r"layout\[4\]"):
            Layout.from_meta(broken, "layout")


def test_a_crash_never_improves_the_score():
    """On a track of four times the length, a lap may take longer than 8 s."""
    track = track_of(4.0 * ref.GATES, ref.GATE_YAW)
    assert lap_length(track) == pytest.approx(56.0)
    gate = "track.gates=[{position: [4, 3, -1.5]}]"
    one = make_race(
        "track.closed=false", "evaluate.laps=1", "track.start={position: [0, 0, -1.5]}", gate
    )
    assert lap_length(one[1].track) == 5.0  # a course of one gate, from its start
    limit = time_limit(track, 6)
    slow = np.full((4, 6), 10.0)
    crashed = slow.copy()
    crashed[0, 1:] = np.nan
    finished = Laps(slow, ("",) * 4, slow.sum(1), limit)
    one_less = Laps(crashed, ("hit a gate", "", "", ""), slow.sum(1), limit)
    assert finished.score == 60.0 and one_less.score > finished.score
    assert time_limit(track_of(ref.GATES, ref.GATE_YAW), 6) == 48.0
