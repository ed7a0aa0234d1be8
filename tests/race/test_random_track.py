"""Random tracks, checked in float64 from the gates of a config, and training on many of them."""

import itertools
import json

import chex
import jax
import numpy as np
import pytest

from quadjax import make_race
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED, preset_names
from tests.commands import run
from tests.promotion import QUICK

PRESET = "e2e"
SETTINGS = [
    {},
    {"gates": 4, "turn_deg": 100, "leg": [2.5, 4]},
    {"gates": 25, "height": [1.05, 6], "frame": 0.2, "size": [1.2, 1.0]},
    {"gates": 10, "turn_deg": 60, "leg": [4, 12]},
    {"leg": [2, 12], "leg_ratio": 3, "yaw_deg": 45, "turn_deg": 130, "size": [1, 1]},
]


def generate(seed=0, **settings):
    overrides = [f"track.generate.{key}={value}" for key, value in settings.items()]
    return load_config(PRESET, [f"track.generate.seed={seed}", *overrides])


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda s: "-".join(s) or "defaults")
def test_a_random_track_keeps_to_its_settings(settings):
    """Frames do not touch in any direction, and are above the ground."""
    for seed in range(2):
        config = generate(seed, **settings)  # which checks that the race is possible
        gates = config.track.gates
        assert len(gates) == settings.get("gates", 8) and config.track.generate is None
        places = np.array([gate.position for gate in gates])
        low, high = settings.get("height", [1.2, 2.5])
        assert np.all((-places[:, 2] >= low - 0.01) & (-places[:, 2] <= high + 0.01))
        width, height = np.add(settings.get("size", [1.5, 1.5]), 2 * settings.get("frame", 0.3))
        assert np.all(-places[:, 2] >= 0.5 * height - 1e-6)
        apart = [np.linalg.norm((a - b)[:2]) for a, b in itertools.combinations(places, 2)]
        assert min(apart) >= width + 0.2
        _check_legs(settings, gates, places)


def _check_legs(settings, gates, places):
    """Lengths and turns, and that a drone meets each gate from behind it."""
    yaw = np.radians([gate.yaw_deg for gate in gates])
    legs = places[:, :2] - np.roll(places[:, :2], 1, axis=0)
    length = np.linalg.norm(legs, axis=1)
    short, long = settings.get("leg", [3, 8])
    assert np.all((length >= short - 1e-6) & (length <= long + 1e-6))
    unit = legs / length[:, None]
    cosine = np.sum(unit * np.roll(unit, -1, axis=0), axis=1)
    limit = np.radians(settings.get("turn_deg", 120))
    assert np.all(np.arccos(np.clip(cosine, -1, 1)) <= limit + 1e-6)
    through = np.sum(unit * np.stack([np.cos(yaw), np.sin(yaw)], axis=1), axis=1)
    aside = np.radians(settings.get("yaw_deg", 0))
    most = min(0.5 * limit + aside, max(0.5 * limit, np.radians(85)))
    assert np.all(through >= np.cos(most) - 0.01)
    assert length.max() <= settings.get("leg_ratio", np.inf) * length.min() + 1e-6
    mean = np.arctan2(*(unit + np.roll(unit, -1, axis=0)).T[::-1])
    off = np.abs((yaw - mean + np.pi) % (2 * np.pi) - np.pi)
    assert np.all(off <= aside + 0.01) and (off.max() > 0.1) == (aside > 0)


def test_the_seed_and_the_settings_determine_the_track():
    assert generate(3).track == generate(3).track
    assert generate(3).track != generate(4).track
    assert generate(3).track.name == "random_8_3"


def test_settings_come_from_files_and_a_saved_config_has_the_track(tmp_path):
    config, saved = tmp_path / "config.yaml", tmp_path / "saved.yaml"
    config.write_text(f"base: {PRESET}\ntrack: {{generate: {{seed: 4}}}}\n")
    assert load_config(config).track.gates == generate(4).track.gates
    assert load_config(config, ["track=square4"]).track.name == "square4"
    saved.write_text(load_config(config).to_yaml())
    assert load_config(saved) == load_config(config)


def test_the_command_writes_and_describes_a_track(tmp_path, capsys):
    file, figure = str(tmp_path / "new.yaml"), tmp_path / "new.png"
    assert run("show", file, "seed=4", "gates=6", "--write", "track", "--figure", figure) == 0
    text = capsys.readouterr().out
    assert "new: 6 gates, a lap of" in text and figure.stat().st_size > 1000
    loaded = load_config(PRESET, [f"track={file}"])
    assert loaded.track.gates == generate(4, gates=6).track.gates
    assert run("show", file, "seed=5", "--write", "track") == 2
    assert "already exists" in capsys.readouterr().err


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
        chex.assert_trees_all_equal(following.replace(track=None), single)
        chex.assert_trees_all_equal(rest, others)
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


@pytest.mark.slow
def test_flights_on_new_tracks_are_counted(tmp_path, capsys):
    arguments = ["evaluate", "e2e +fastest", "--policy", str(PRETRAINED / "e2e_fastest.npz")]
    arguments += ["--conditions", "random-tracks"]
    options = ("--runs", 4, "--laps", 2, "--json", tmp_path / "found.json")
    assert run(*arguments, *options) == 0
    found = json.loads((tmp_path / "found.json").read_text())
    (row,) = found["flights"]
    assert row["runs"] == 4 and row["label"] == "256 to 259"
    assert row["finished"] + row["crashed"] == 4 and sum(row["crashes"].values()) == row["crashed"]
    assert f"{row['finished']} of 4" in capsys.readouterr().out


GATE = "{position: [%d, %d, %d], yaw_deg: %d, pitch_deg: %d}"
HEADINGS = [  # start of a course, gates (x, y, z, yaw, pitch), numbers of those that are marked
    ("", [(9, 0, -2, 45, 0), (9, 9, -2, 135, 0), (0, 9, -2, -135, 0), (0, 0, -2, -45, 0)], ""),
    ("", [(9, 0, -2, 45, 0), (9, 9, -2, 180, 0), (0, 9, -2, -135, 0), (0, 0, -2, -45, 0)], ""),
    ("", [(9, 0, -2, 45, 0), (9, 9, -2, 185, 0), (0, 9, -2, -135, 0), (0, 0, -2, -45, 0)], "2"),
    ("", [(9, 0, -2, 225, 0), (9, 9, -2, 135, 0), (0, 9, -2, -135, 0), (0, 0, -2, 50, 0)], "1, 4"),
    ("", [(9, 0, -2, 0, 0), (9, 0, -6, 180, 0), (0, 0, -2, 0, 0)], "3"),  # one above the other
    ("", [(9, 0, -6, 0, -90), (9, 0, -2, 180, 0), (0, 0, -6, 90, 0)], ""),  # a dive
    ("", [(9, 0, -6, 0, 90), (9, 0, -2, 180, 0), (0, 0, -6, 90, 0)], "1"),
    ("[0, 0, -2]", [(9, 0, -2, 45, 0), (9, 9, -2, 90, 0)], ""),  # no leg after the last gate
    ("[0, 0, -2]", [(9, 0, -2, 135, 0), (9, 9, -2, 90, 0)], "1"),
]


@pytest.mark.parametrize(("start", "gates", "marked"), HEADINGS)
def test_gates_against_their_legs_are_marked(start, gates, marked, tmp_path, capsys):
    path = tmp_path / "track.yaml"
    course = f"closed: false\nstart: {{position: {start}}}\n" if start else ""
    path.write_text(f"{course}gates: [{', '.join(GATE % gate for gate in gates)}]\n")
    assert run("show", path) == 0
    text = capsys.readouterr().out
    names = f"check yaw_deg of gate{'s' if ',' in marked else ''} {marked}"
    assert (names in text) == bool(marked) and text.count("*") == len(marked.split()) + bool(marked)


def test_a_track_is_shown_for_any_width_of_the_drone(tmp_path, capsys):
    path = tmp_path / "small.yaml"
    settings = ("seed=4", "gates=4", "size=[0.2, 0.2]", "frame=0.1")
    assert run("show", path, *settings, "--write", "track") == 0
    assert run("show", path) == 0 and "0.2 x 0.2" in capsys.readouterr().out


@pytest.mark.parametrize("name", preset_names("tracks"))
def test_no_gate_of_a_shipped_track_is_marked(name, capsys):
    assert run("show", name) == 0 and "*" not in capsys.readouterr().out
