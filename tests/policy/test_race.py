"""Every command flies a policy file in the same race."""

import dataclasses
import importlib

import pytest

from quadjax.config import assembly
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED, policy_names
from quadjax.evaluation import sources
from quadjax.evaluation.conditions import Condition
from quadjax.export import convert, race_source
from quadjax.limits import guess
from quadjax.plant import flights as plant_flights
from quadjax.policy.file import Policy
from quadjax.policy.race import differences, race_of_policy
from quadjax.training.build import untrained_policy
from tests.commands import run
from tests.frozen.parts import RACES

evaluation, compare = (  # not the functions
    importlib.import_module(f"quadjax.evaluation.{name}") for name in ("evaluate", "compare")
)


@pytest.fixture
def races(monkeypatch):
    """The configs of the races that commands are about to fly; they stop there."""
    seen = []

    def stop(*arguments, **_):
        seen.extend(x for x in arguments if hasattr(x, "vehicle") and hasattr(x, "run"))
        raise InputError("stopped")

    for module, name in (
        (sources, "evaluate"),
        (assembly, "make_race"),
        (convert, "policy_race"),
        (race_source, "policy_race"),
    ):
        monkeypatch.setattr(module, name, stop)
    return seen


def commands(path, folder):
    """Commands of a policy file, and the words that name a race for it."""
    return (
        (("view", path, "--output", folder / "out.html"), ("--race", "e2e")),
        (("evaluate", "--policy", path), ("e2e",)),
        (("export", path, "--output", folder / "c"), ("--race", "e2e")),
        (("replay", folder / "log.csv", "--policy", path), ("--race", "e2e")),
    )


SHIPPED = RACES | {name: name for name in ("e2e_cyberzoo", "indi_cyberzoo")}


@pytest.mark.parametrize("name", SHIPPED)
def test_every_command_flies_the_same_race(name, races, tmp_path, capsys):
    assert set(SHIPPED) == set(policy_names())
    path = PRETRAINED / f"{name}.npz"
    for words, _ in commands(path, tmp_path):
        assert run(*words) == 2
        assert "error: stopped" in capsys.readouterr().err
    assert len(races) == 4 and all(race == races[0] for race in races)
    preset = load_config(SHIPPED[name])
    assert races[0].track.gates == preset.track.gates and races[0].rules == preset.rules
    assert races[0].vehicle.residual == preset.vehicle.residual


DIFFERENCES = (  # overrides of the training and of a race, and the difference
    ("indi", ["vehicle.constants.thrust_max=18"], [], ["vehicle.constants.thrust_max is 18 in"]),
    (
        "e2e",
        ["vehicle=5inch"],
        [],
        ["vehicle is 5-inch racing quadcopter in training, Parrot Bebop 1 here"],
    ),
    ("e2e", ["track=figure8"], [], ["track is figure8 in training, square4 here"]),
    ("e2e", [], ["rules.position_limit=20"], ["rules.position_limit is 10 in training, 20 here"]),
    ("e2e", [], ["vehicle.mismatch={k_w: 0.9}"], ["vehicle.mismatch.k_w is null in training, 0.9"]),
    (
        "e2e",
        [],
        ["vehicle.residual=standin_residual.npz"],
        ["vehicle.residual is null in training"],
    ),
    ("e2e", [], ["battery={}"], ["battery is null in training, given here"]),
    ("e2e", ["seed=1", "reward.gate=2", "vehicle.width=0.1", "name=other"], [], []),
)


@pytest.mark.parametrize(("preset", "training", "race", "texts"), DIFFERENCES)
def test_differences_are_of_what_flies(preset, training, race, texts):
    found = [*map(str, differences(load_config(preset, training), load_config(preset, race)))]
    for text in texts:
        assert any(x.startswith(text) for x in found), found
    assert len(found) == len(texts)


def test_a_residual_is_compared_by_its_networks(tmp_path):
    copy = tmp_path / "copy.npz"
    copy.write_bytes((PRETRAINED / "standin_residual.npz").read_bytes())
    pair = [load_config("e2e", [f"vehicle.residual={x}"]) for x in ("standin_residual.npz", copy)]
    assert not list(differences(*pair))


def test_every_command_warns_of_another_race(tmp_path, capsys, monkeypatch):
    """A policy with a thrust of up to 18 m/s^2 in a race of up to 15 m/s^2."""

    def stop(*_, **__):
        raise InputError("stopped")

    for module, name in (
        (evaluation, "simulate"),
        (convert, "policy_race"),
        (race_source, "policy_race"),
        (plant_flights, "plan_race"),
        (guess, "make_race"),
        (compare, "evaluate"),
    ):
        monkeypatch.setattr(module, name, stop)
    own = load_config("indi", ["vehicle.constants.thrust_max=18"])
    path = tmp_path / "indi18.npz"
    untrained_policy(own).save(path)
    text = "thrust_max is 18 in training, 15 here (without a config it flies its own race)"
    export, sil = ("export", path, "--output", tmp_path / "c"), ("sil", path, "--output", tmp_path)
    logs = ("logs", "standin", "--policy", path, "--output", tmp_path / "logs")
    duel = (
        "compare",
        "standin",
        "--e2e",
        "e2e",
        "--e2e",
        "e2e",
        "--indi",
        path,
        "--output",
        tmp_path,
    )
    for words, race in (
        *commands(path, tmp_path)[:2],
        ((*export, "--allow-other-race"), ("--race", "indi")),
        *commands(path, tmp_path)[3:],
        (sil, ("--race", "indi")),
        (logs, ("--race", "indi")),
        (duel, ("--race", "indi")),
    ):
        assert run(*words) == 2
        error = capsys.readouterr().err
        assert "error: stopped" in error and "warning" not in error
        named = ["indi" if x == "e2e" else x for x in race]
        assert run(*words, *named) == 2
        error = capsys.readouterr().err
        assert error.count("warning: ") == 1 and text in error, (words, error)
        assert f"warning: {path.name}" in error or f"warning: {path}" in error
    assert run("limit", "indi", "--policy", path) == 2
    assert text in capsys.readouterr().err


def test_a_file_without_a_config_needs_one_that_is_named(races, tmp_path, capsys):
    """Neither the preset that ``source`` names nor a config next to the file is taken for it."""
    path = tmp_path / "alone.npz"
    source = {"config": "e2e_seed1"}
    dataclasses.replace(Policy.load("e2e"), config=None, source=source).save(path)
    (tmp_path / "config.yaml").write_text("base: e2e\n")
    for words, race in commands(path, tmp_path):
        assert run(*words) == 2
        error = " ".join(capsys.readouterr().err.split())
        assert "alone.npz: has no config; name the config of its race" in error
        option = "CONFIG or --race CONFIG"
        assert f"({option})" in error
        assert run(*words, *race) == 2
        assert "error: stopped" in capsys.readouterr().err
    assert len(races) == 4 and all(race == load_config("e2e") for race in races)
    with pytest.raises(
        InputError,
        match=r"name the config of its race \(CONFIG or --race CONFIG\)",
    ):
        convert.export_c(path, tmp_path / "c")


def test_a_named_config_comes_first():
    policy = Policy.load("e2e_residual_disturbance")
    assert race_of_policy(policy)[0].name == "e2e_residual_disturbance_seed3"
    assert race_of_policy(policy, config="e2e")[0] == load_config("e2e")
    flown, origin = race_of_policy(policy, track="figure8")
    assert origin == "the policy file's config, track figure8"
    assert flown.track.gates == load_config("e2e", ["track=figure8"]).track.gates


OWN = """
closed: false
start: {position: [30, 2, 0], yaw_deg: 180}
rules: {position_limit: 45, bounds: [[-1, 40], [-9, 9], [-7, 1]], gate_frame: 0.4, ground_speed: 6}
gates: [{position: [20, 0, -2], yaw_deg: 180, size: [2, 2]}, {position: [4, 0, -2], yaw_deg: 170}]
"""
TRACKS = ("split_s", "grand_challenge", "own.yaml", "small.yaml")


@pytest.mark.parametrize("track", TRACKS)
@pytest.mark.parametrize("preset", ["e2e", "indi", "e2e_race"])
def test_a_track_of_a_policy_brings_its_rules(track, preset, tmp_path, monkeypatch):
    """As the override ``track``: limits, bounds and frames of the file, and a check of both."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.yaml").write_text(OWN)
    (tmp_path / "small.yaml").write_text("gates: [{position: [9, 0, -2]}, {position: [4, 0, -2]}]")
    stored = load_config(preset).model_dump(mode="json", by_alias=True)
    policy = dataclasses.replace(Policy.load("e2e"), config=stored)
    laps = ["evaluate.laps=1"] if track == "own.yaml" else []
    expected, race = load_config(preset, [f"track={track}", *laps]), load_config(preset)
    condition = Condition(label="there", overrides=(f"track={track}",))
    for found in (race_of_policy(policy, track=track)[0], condition.race(race)):
        for section in ("track", "rules", "evaluate", "vehicle", "observation"):
            assert getattr(found, section) == getattr(expected, section)
        assert found.reward == race.reward  # in the units of the race of training


def test_a_track_that_does_not_fit_the_race_of_a_policy_is_refused(tmp_path):
    path = tmp_path / "far.yaml"
    path.write_text("gates: [{position: [85, 0, -2]}, {position: [4, 0, -2]}]")
    message = r"gates\[0\]\.position is .* below rules\.position_limit, 10 m; a track file may set"
    with pytest.raises(InputError, match=message):
        race_of_policy(Policy.load("e2e"), track=str(path))
