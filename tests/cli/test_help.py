"""What the help of a subcommand names exists."""

import re
import shlex

import pytest

from quadjax.cli import COMMANDS
from quadjax.core.resources import policy_names, preset_names
from tests.commands import run

KINDS = {  # of the positional names of a command; presets of the others
    "view": policy_names(),
    "export": policy_names(),
    "show": preset_names(),
    "fit": preset_names("fit"),
    "sweep": preset_names("sweeps"),
    **dict.fromkeys(("compare", "logs"), preset_names("plant")),
}
OPTIONS = {
    "--race": preset_names(),
    "--policy": policy_names(),
    "--logs": preset_names("fit"),
    "--fit": preset_names("fit"),
    "--plant": preset_names("plant"),
}
PARTS = preset_names("parts")
OVERRIDES = {"track": preset_names("tracks"), "vehicle": preset_names("vehicles")}


def help_of(command, capsys):
    assert run(command, "--help") == 0
    return capsys.readouterr().out


def unknown(example):
    """The names in an example, ``quadjax COMMAND ..``, that do not come with the package."""
    _, command, *words = shlex.split(example)
    found, option = [], None
    for word in words:
        name, equals, value = word.partition("=")
        if word.startswith("+"):
            found += [] if any(f"_{word[1:]}" in f"_{part}" for part in PARTS) else [word]
            continue
        if option is not None:
            known, word = OPTIONS.get(option), word
        elif equals:
            known, word = OVERRIDES.get(name), value
        else:
            known = KINDS.get(command, preset_names())
        option = word if word.startswith("-") else None
        if known is not None and option is None and not re.search(r"[./]|^\d+$", word):
            found += [] if word in known else [word]
    return found


def test_a_name_of_another_kind_is_unknown():
    assert unknown("quadjax view e2e indi --race e2e_residual") == ["e2e_residual"]
    assert unknown("quadjax train e2e_residual track=no") == ["e2e_residual", "no"]
    assert unknown("quadjax replay a/log.csv --policy e2e --logs px5") == ["px5"]


@pytest.mark.parametrize("command", COMMANDS)
def test_examples_name_presets_and_policies_that_exist(command, capsys):
    text = help_of(command, capsys)
    assert f"Usage: quadjax {command} " in text
    text = text.partition("Example")[2].partition("\n\n")[0]
    examples = re.findall(r"quadjax [\w-]+ .*", " ".join(text.split()))
    assert examples and examples[0].split()[1] == command and unknown(examples[0]) == []


@pytest.mark.parametrize("command", [name for name in KINDS if name != "view"])
def test_configs_that_are_shipped_are_listed_by_name(command, capsys):
    text = help_of(command, capsys)
    assert "configs/" not in text
    if command in ("fit", "sweep", "logs", "compare"):
        assert all(name in text for name in KINDS[command])
        more = ["--policy", "e2e", "--output", "x"] if command == "logs" else []
        assert run(command, "configs/nosuch.yaml", *more) == 2
        error = capsys.readouterr().err
        assert "configs/nosuch.yaml: no such" in error and ", ".join(KINDS[command]) in error
