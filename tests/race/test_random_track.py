"""Random tracks: every condition is checked in float64, from the gates of the loaded config."""

import itertools

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from tests.commands import run

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


def test_settings_come_from_files_and_overrides(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("generate: {seed: 4, gates: 6}\n")
    track = load_config(PRESET, [f"track={file}"]).track
    assert len(track.gates) == 6 and track.name == "mine"
    assert track.gates == generate(4, gates=6).track.gates
    more = load_config(PRESET, [f"track={file}", "track.generate.gates=5"]).track
    assert more.gates == generate(4, gates=5).track.gates
    config = tmp_path / "config.yaml"
    config.write_text(f"base: {PRESET}\ntrack: {{generate: {{seed: 4}}}}\n")
    assert load_config(config).track.gates == generate(4).track.gates
    assert load_config(config, ["track=square4"]).track.name == "square4"
    assert load_config(config, ["rules.position_limit=40"]).rules.position_limit == 40
    saved = tmp_path / "saved.yaml"
    saved.write_text(load_config(config).to_yaml())
    assert load_config(saved) == load_config(config)


IMPOSSIBLE = (
    (["track.generate=3"], "track.generate is 3, allowed: a valid dictionary"),
    (["track.generate.leg=[5, 3]"], "leg is [5, 3], allowed: [lowest, highest]"),
    (["track.generate.leg=[1, 2]"], "leg is [1.0, 2.0], allowed: a longest of at least 2.3"),
    (["track.generate.leg_ratio=3"], "leg_ratio is 3, allowed with leg [3.0, 8.0]: less than"),
    (["track.generate.height=[1, 2]"], "height is [1.0, 2.0], allowed: at least 1.05"),
    (["track.generate.turn_deg=20"], "found no track with gates 8, leg [3.0, 8.0] and turn_d"),
    (["track.generate.seed=1", "track.closed=false"], "track.closed has no effect"),
    (["track=square4", "track.generate.seed=1"], "track.gates has no effect"),
    (["track.generate.seed=1", "rules.position_limit=3"], "track.gates[0].position is"),
)


def test_impossible_settings_are_one_line():
    for overrides, message in IMPOSSIBLE:
        with pytest.raises(InputError) as error:
            load_config(PRESET, overrides)
        assert message in str(error.value) and "\n" not in str(error.value), overrides


def test_the_command_writes_and_describes_a_track(tmp_path, capsys):
    file, figure = str(tmp_path / "new.yaml"), tmp_path / "new.png"
    assert run("show", file, "seed=4", "gates=6", "--write", "track", "--figure", figure) == 0
    text = capsys.readouterr().out
    assert "new: 6 gates, a lap of" in text and figure.stat().st_size > 1000
    loaded = load_config(PRESET, [f"track={file}"])
    own = generate(4, gates=6)
    assert loaded.track.gates == own.track.gates and loaded.rules == own.rules
    assert run("show", file, "seed=5", "--write", "track") == 2
    assert "exists already" in capsys.readouterr().err
    assert run("show", "grand_challenge") == 0
    text = capsys.readouterr().out
    row = text.splitlines()[7]
    assert "11 gates" in text and row.split()[5:] == ["22.09", "0", "-", "1.5", "x", "1.5"]
