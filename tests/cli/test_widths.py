"""Texts of at most 79 characters, and names of shipped policies in the place of files."""

from pathlib import Path

import pytest

from quadjax.cli import call
from quadjax.cli.options import PolicyFile
from quadjax.core.resources import PRETRAINED
from quadjax.export.verify.result import PASSED, Result, row_text
from quadjax.policy.file import Policy
from tests.commands import run


@pytest.mark.parametrize("command", [["show"], ["show", "e2e"]])
def test_lists_fit_a_terminal(command, capsys):
    assert run(*command) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 10
    text = [line for line in lines if command == ["show"] or line.lstrip().startswith("#")]
    assert text and max(map(len, text)) < 80


def test_a_row_of_the_verification_is_wrapped():
    lines = row_text(Result("accuracy", PASSED, "a long figure " * 20, 1.0), 20).splitlines()
    assert len(lines) > 3 and max(map(len, lines)) < 80
    assert all(line.startswith(" " * 10) for line in lines[1:])


def test_a_shipped_policy_has_a_name():
    found: list[Path] = []

    def command(*, policy: list[PolicyFile]) -> None:
        found.extend(policy)

    call(command, "quadjax", ["--policy", "e2e_fastest", "--policy", "mine.npz"])
    assert found == [PRETRAINED / "e2e_fastest.npz", Path("mine.npz")]
    assert Policy.load("e2e_fastest").layers
