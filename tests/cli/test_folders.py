"""Folders of the user: they hide no name of the package, and nothing is mixed with their files."""

import shutil

import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED, find_config, find_policy
from quadjax.evaluation import evaluate, sources
from quadjax.fitting.config import load_fit_config
from quadjax.policy.file import Policy
from tests.commands import run


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_a_folder_does_not_hide_a_shipped_name(here, monkeypatch, capsys):
    for name in ("paparazzi", "e2e", "e2e_residual", "square4"):
        (here / name).mkdir()
    assert load_fit_config("paparazzi").logs.format == "paparazzi"
    assert load_config("e2e", ["track=square4"]).name == "e2e"
    assert find_policy("e2e") == PRETRAINED / "e2e.npz"
    assert Policy.load("e2e_residual").layers
    stop(monkeypatch)
    for command in (("view", "e2e"), ("evaluate", "--policy", "e2e")):
        assert run(*command) == 2
        assert "error: stopped" in capsys.readouterr().err
    with pytest.raises(InputError, match="is a directory"):
        load_config(here)
    (here / "mine").mkdir()
    assert find_config("mine").is_dir()


def stop(monkeypatch):
    def stopped(*_, **__):
        raise InputError("stopped")

    monkeypatch.setattr(sources, "evaluate", stopped)
    monkeypatch.setattr(evaluate, "evaluate", stopped)


def test_a_copy_of_a_run_without_its_hidden_file_is_viewed(here, monkeypatch, capsys):
    stop(monkeypatch)
    (here / "copy").mkdir()
    shutil.copy(PRETRAINED / "e2e_residual_disturbance.npz", here / "copy" / "policy.npz")
    for command in (("view", "copy"), ("evaluate", "--policy", "copy")):
        assert run(*command) == 2
        assert "error: stopped" in capsys.readouterr().err
    (here / "empty").mkdir()
    assert run("view", "empty") == 2
    assert "empty: no policy.npz, expected the folder of a training run" in capsys.readouterr().err
