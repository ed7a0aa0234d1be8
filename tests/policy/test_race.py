"""Every command flies a policy file in the same race."""

import dataclasses
from pathlib import Path

import pytest

from quadjax import sources
from quadjax.config import assembly
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED, policy_names
from quadjax.export import convert, race_source
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from tests.commands import run
from tests.export.support import made_policy

PRESETS = {  # of the shipped policies
    "e2e": "e2e +residual",
    "e2e_adaptive": "e2e +residual +disturbance",
    "e2e_fastest": "e2e +fastest",
    "e2e_nominal": "e2e",
    "indi": "indi +fastest",
    "indi_shac": "indi",
}


@pytest.fixture
def races(monkeypatch):
    """The configs of the races that commands are about to fly; they stop there."""
    found = []

    def stop(*arguments, **_):
        found.extend(
            each for each in arguments if hasattr(each, "vehicle") and hasattr(each, "run")
        )
        raise InputError("stopped")

    for module, name in (
        (sources, "evaluate"),
        (assembly, "race_of"),
        (convert, "own_race"),
        (race_source, "own_race"),
    ):
        monkeypatch.setattr(module, name, stop)
    return found


def commands(path, folder):
    return (
        ("view", path, "--output", folder / "out.html"),
        ("evaluate", "--policy", path),
        ("export", path, "--output", folder / "c"),
        ("replay", folder / "log.csv", "--policy", path),
    )


def imported(folder):
    """A policy file as of the published C arrays, converted by an earlier version."""
    policy = dataclasses.replace(made_policy(8), source={"config": "authors_code_seed1"})
    policy.save(folder / "published.npz")
    return folder / "published.npz"


@pytest.mark.parametrize("name", [*PRESETS, "published"])
def test_every_command_flies_the_same_race(name, races, tmp_path, capsys):
    assert set(PRESETS) == set(policy_names())
    path = imported(tmp_path) if name == "published" else PRETRAINED / f"{name}.npz"
    for command in commands(path, tmp_path):
        assert run(*command) == 2
        assert "error: stopped" in capsys.readouterr().err
    assert len(races) == 4 and all(race == races[0] for race in races)
    preset = load_config(PRESETS.get(name, "e2e_paper +authors_code"))
    residual = Policy.load(path).source.get("residual", preset.vehicle.residual)
    assert races[0].track.gates == preset.track.gates and races[0].rules == preset.rules
    assert Path(races[0].vehicle.residual or "").name == (residual or "")


def test_a_file_without_a_race_is_refused_by_every_command(races, tmp_path, capsys):
    path = tmp_path / "alone.npz"
    dataclasses.replace(made_policy(8), source={"made": "up"}).save(path)
    (tmp_path / "config.yaml").write_text("base: e2e\n")
    for command in commands(path, tmp_path):
        assert run(*command) == 2
        error = " ".join(capsys.readouterr().err.split())
        assert "alone.npz: contains no config and names no preset, name the config" in error
        option = "quadjax evaluate CONFIG" if command[0] == "evaluate" else "--race CONFIG"
        assert f"({option})" in error
        config = ["e2e"] if command[0] == "evaluate" else ["--race", "e2e"]
        assert run(*command, *config) == 2
        assert "error: stopped" in capsys.readouterr().err
    assert len(races) == 4 and all(race == load_config("e2e") for race in races)
    with pytest.raises(InputError, match=r"name the config of its race \(config=CONFIG\)"):
        convert.export_c(path, tmp_path / "c")


def test_a_named_config_comes_first(tmp_path):
    policy = Policy.load("e2e_adaptive")
    assert race_of_policy(policy)[0].name == "e2e_adaptive"
    assert race_of_policy(policy, config="e2e")[0] == load_config("e2e")
    flown, origin = race_of_policy(policy, track="figure8")
    assert origin == "the policy file's config, track figure8"
    assert flown.track.gates == load_config("e2e", ["track=figure8"]).track.gates
