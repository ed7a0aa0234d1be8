"""Training on random tracks: one is drawn for every episode."""

import json

import jax
import numpy as np
import pytest

from quadjax import make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from tests.commands import run
from tests.promotion import QUICK

KEYS = [
    "randomization.tracks.count=5",
    "randomization.tracks.seed=3",
    "randomization.tracks.gates=6",
]


def race(*keys):
    return make_race(load_config("e2e +fastest", [*KEYS, *keys, "start.heading=north"]))


def drawn(environment, params, count):
    reset = jax.vmap(environment.reset, in_axes=(None, 0))
    keys = jax.random.split(jax.random.key(0), count)
    return jax.tree.map(np.asarray, jax.jit(reset, compiler_options=QUICK)(params, keys))


@pytest.fixture(scope="module")
def flown():
    """A race on random tracks, and starts of it."""
    environment, params = race("observation.gates_ahead=2")
    return environment, params, drawn(environment, params, 200)


def test_every_episode_is_on_one_of_the_tracks(flown):
    _, params, states = flown
    firsts = np.asarray(params.tracks.position.x)[:, 0]
    index = [int(np.flatnonzero(firsts == x)[0]) for x in states.track.position.x[:, 0]]
    assert set(index) == set(range(5)) and np.bincount(index).min() > 20
    assert np.abs(np.asarray(params.tracks.position.x)).max() < params.rules.position_limit


def test_a_drawn_track_is_raced_as_a_track_of_its_own(flown):
    environment, params, states = flown
    other = np.flatnonzero(states.track.position.x[:, 0] != params.tracks.position.x[0, 0])[0]
    state = jax.tree.map(lambda leaf: leaf[other], states)
    alone = params.replace(track=state.track, tracks=None)
    action = np.full(4, 0.2, np.float32)
    step = jax.jit(environment.step, compiler_options=QUICK)
    observe = jax.jit(environment.observe, compiler_options=QUICK)
    for _ in range(3):
        here = observe(params, state)
        there = observe(alone, state.replace(track=None))
        np.testing.assert_array_equal(here, there)
        following, *rest = step(params, state, action)
        single, *others = step(alone, state.replace(track=None), action)
        jax.tree.map(np.testing.assert_array_equal, following.replace(track=None), single)
        jax.tree.map(np.testing.assert_array_equal, rest, others)
        state = following
    assert not np.array_equal(state.track.position.x, params.track.position.x[:6])


def test_headings_of_one_track_are_refused_on_random_tracks():
    with pytest.raises(InputError, match="start.heading is .inside_turn., allowed: north"):
        load_config("e2e +fastest", [*KEYS, "start.heading=inside_turn"])
    environment, params = race()
    inside = make_race(load_config("e2e +fastest", ["start.heading=inside_turn"]))[1]
    params = params.replace(heading=inside.heading)
    with pytest.raises(InputError, match="params.heading is set, allowed: None with params"):
        environment.reset(params, jax.random.key(0))


def test_flights_on_new_tracks_are_counted(tmp_path, capsys):
    arguments = ["evaluate", "e2e +fastest", "--policy", str(PRETRAINED / "e2e_fastest.npz")]
    arguments += ["--study", "random-tracks"]
    options = ("--runs", 4, "--laps", 2, "--json", tmp_path / "found.json")
    assert run(*arguments, *options) == 0
    found = json.loads((tmp_path / "found.json").read_text())
    (row,) = found["flights"]
    assert row["runs"] == 4 and row["label"] == "256 to 259"
    assert row["finished"] + row["crashed"] == 4 and sum(row["crashes"].values()) == row["crashed"]
    assert f"{row['finished']} of 4" in capsys.readouterr().out
