"""Modules that untrusted files name are not imported; those that the user names are."""

import dataclasses
import sys

import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import write_json
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation import curves, training
from quadjax.export import folder as exported
from quadjax.export.conversion import Options, sha256
from quadjax.fitting.config import LogsConfig, load_fit_config
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.training.folder import check_same
from quadjax.training.result import Run
from tests.commands import run

NAMES = "code that this file names is not imported, name the config of its race ("


@pytest.fixture
def foreign(tmp_path, monkeypatch):
    """The current folder has untrusted files: rf/policy.npz, rf/config.yaml and foreign.py."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "foreign.py").write_text("open('ran', 'w').close()\n")
    folder = tmp_path / "rf"
    folder.mkdir()
    config = load_config("e2e").model_dump(mode="json", by_alias=True)
    config["vehicle"]["model"] = "foreign:MODEL"
    policy = Policy.load(PRETRAINED / "e2e.npz")
    dataclasses.replace(policy, config=config).save(folder / "policy.npz")
    text = "base: e2e\nvehicle: {model: 'foreign:MODEL'}\n"
    (folder / "config.yaml").write_text(text)
    (tmp_path / "mine.yaml").write_text(text)
    yield folder
    sys.modules.pop("foreign", None)


def ran(folder):
    return (folder.parent / "ran").exists()


def export_of(folder):
    """The folder as one of an export, whose hash its author has adapted."""
    report = {"options": dataclasses.asdict(Options("x")), "policy": "policy.npz"}
    report["config_sha256"] = sha256(folder / "config.yaml")
    write_json(folder / "x_report.json", report)


@pytest.mark.parametrize("named", [False, True])
@pytest.mark.parametrize(
    "command",
    [
        ("export", "rf/policy.npz", "--output", "out"),
        ("evaluate", "--policy", "rf"),
        ("evaluate", "--policy", "rf/policy.npz"),
        ("view", "rf"),
        ("view", "rf/policy.npz"),
        ("replay", "log.csv", "--policy", "rf/policy.npz"),
        ("verify", "rf"),
        ("sil", "rf", "--simulator"),
    ],
    ids=" ".join,
)
def test_code_of_a_found_file_is_imported_only_if_the_user_names_a_config(
    foreign, command, named, monkeypatch, capsys
):
    if command[0] in ("verify", "sil"):
        export_of(foreign)
        monkeypatch.setattr(exported, "report_text", lambda *_: "")
    config = ["mine.yaml"] if command[0] == "evaluate" else ["--race", "mine.yaml"]
    assert run(*command, *(config if named else [])) == 2
    error = capsys.readouterr().err
    option = "CONFIG or --race CONFIG"
    assert ("has no 'MODEL'" if named else f"{NAMES}{option})") in " ".join(error.split())
    assert ran(foreign) == named


def test_code_of_rules_is_not_imported_either(foreign, capsys):
    path = foreign / "policy.npz"
    config = load_config("e2e").model_dump(mode="json", by_alias=True)
    config["rules"]["extra"] = ["foreign:RULE"]
    dataclasses.replace(Policy.load(path), config=config).save(path)
    assert run("evaluate", "--policy", path) == 2
    assert NAMES in " ".join(capsys.readouterr().err.split()) and not ran(foreign)


def test_a_policy_flies_without_the_terms_of_its_reward(foreign, capsys):
    """They are not imported; a config that is found, of a run, is refused with them."""
    path, schedule = foreign / "policy.npz", {"linear": [0.0, 1.0]}
    config = load_config("e2e").model_dump(mode="json", by_alias=True)
    config["reward"]["terms"] = {"foreign:TERM": 1.0}
    config["schedules"]["reward.terms.foreign:TERM"] = schedule
    dataclasses.replace(Policy.load(path), config=config).save(path)
    assert run("evaluate", "--policy", path, "--runs", 1, "--laps", 1) == 0
    assert race_of_policy(Policy.load(path))[0] == load_config("e2e") and not ran(foreign)
    (foreign / "config.yaml").write_text("base: e2e\nreward: {terms: {'foreign:TERM': 1}}\n")
    with pytest.raises(InputError, match="reward.terms is 'foreign:TERM'; code that this file"):
        Run.load(foreign)


def test_a_config_next_to_a_policy_file_is_not_read(foreign, capsys):
    path = foreign / "policy.npz"
    dataclasses.replace(Policy.load(path), config=None, source={}).save(path)
    assert run("export", path, "--output", "out", "--allow-unfinished") == 2
    assert "policy.npz: has no config; name the config" in capsys.readouterr().err
    assert not ran(foreign)


def test_a_run_is_resumed_with_its_own_code_alone(foreign):
    config = load_config("e2e", ["name=rf", "rules.extra=[foreign:RULE]"])
    (foreign / "config.yaml").write_text(config.to_yaml())
    check_same(config, foreign)
    other = load_config("e2e", ["name=rf"])
    with pytest.raises(InputError, match="rules.extra is 'foreign:RULE'; code that this file"):
        check_same(other, foreign)
    (foreign / "config.yaml").write_text("base: ../mine.yaml\n")
    for each in (config, other):
        with pytest.raises(InputError, match="vehicle.model is 'foreign:MODEL'; code that this"):
            check_same(each, foreign)
    assert not ran(foreign)


def test_python_loads_the_code_of_a_run_only_for_a_named_config(foreign):
    for load in (
        lambda: Run.load(foreign),
        lambda: training.evaluate_seed(foreign, 1),
        lambda: curves.learning_figure({"rf": [foreign]}),
    ):
        with pytest.raises(
            InputError,
            match=r"name the config of its race \(CONFIG or --race CONFIG\)",
        ):
            load()
    assert not ran(foreign)
    with pytest.raises(InputError, match="has no 'MODEL'"):
        Run.load(foreign, foreign / "config.yaml")
    assert ran(foreign)


def log_config(folder):
    path = folder / "columns.yaml"
    path.write_text("logs: {format: 'foreign:FORMAT', files: ['*.csv']}\nbody: {inertia: base}\n")
    (folder / "log.csv").write_text("time\n0.0\n")
    return path


@pytest.mark.parametrize(
    "command",
    [
        ("fit", "columns.yaml"),
        ("view", "log.csv", "--logs", "columns.yaml"),
        ("replay", "log.csv", "--vehicle", "bebop1", "--logs", "columns.yaml"),
        ("report", "log.csv", "--logs", "columns.yaml"),
    ],
    ids=" ".join,
)
def test_a_reader_of_logs_in_a_file_needs_a_word_of_the_user(foreign, command, capsys):
    log_config(foreign.parent)
    assert run(*command) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "columns.yaml: logs.format is 'foreign:FORMAT'" in error and "--allow-code" in error
    assert not ran(foreign)
    assert run(*command, "--allow-code") == 2
    assert "has no 'FORMAT'" in capsys.readouterr().err
    assert ran(foreign)


def test_a_reader_of_logs_on_the_command_line_is_imported(foreign, capsys):
    log_config(foreign.parent)
    path = foreign.parent / "columns.yaml"
    assert run("fit", path, "logs.format=foreign:FORMAT") == 2
    assert "has no 'FORMAT'" in capsys.readouterr().err and ran(foreign)
    assert load_fit_config(path, ["logs={format: foreign:FORMAT}"]).logs.format != "plain"
    with pytest.raises(InputError, match="only with --allow-code"):
        load_fit_config(path, ["logs.files=[a.csv]"])
    assert LogsConfig(format="foreign:FORMAT").format == "foreign:FORMAT"
