"""The subcommand evaluate."""

import json

import pytest
from PIL import Image

from tests.commands import run
from tests.evaluation.support import random_policy


@pytest.fixture(scope="module")
def policy_file(tmp_path_factory) -> str:
    path = tmp_path_factory.mktemp("policy") / "policy.npz"
    random_policy().save(path)
    return str(path)


@pytest.mark.parametrize(
    ("arguments", "names"),
    [
        (["--policy", "POLICY", "--laps", "1000000000"], "1 to 1000"),
        (["--policy", "POLICY", "evaluate.laps=1000000000"], "evaluate.laps"),
        (["--policy", "POLICY", "--json", "/dev/null/a.json"], "/dev/null/a.json"),
        (["--policy", "POLICY", "--figure", "a.xyz"], "a.xyz"),
        (["--policy", "POLICY", "--animation", "a.mp4"], "a.mp4"),
        (["--policy", "POLICY", "vehicle.constants.k_w=heavy"], "k_w"),
        (["--policy", "POLICY", "--nonsense"], "nonsense"),
    ],
)
def test_bad_input_is_one_line_and_status_2(capsys, policy_file, arguments, names):
    given = [policy_file if word == "POLICY" else word for word in arguments]
    assert run("evaluate", "e2e", *given) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("error: ") and names in lines[0]


@pytest.mark.slow
def test_a_flight_leaves_what_was_asked_for(tmp_path, policy_file, capsys):
    """A policy that crashes is a result, not an error."""
    outputs = {name: tmp_path / f"a.{name}" for name in ("json", "png", "gif")}
    arguments = [
        "--laps",
        "1",
        "--runs",
        "2",
        "--policy",
        policy_file,
        "vehicle.constants.k_w=4.5e-8",
    ]
    files = ["--json", outputs["json"], "--figure", outputs["png"], "--animation", outputs["gif"]]
    assert run("evaluate", "e2e", *arguments, *files) == 0
    text = capsys.readouterr().out
    assert "sampled, 2 runs" in text and "0/2" in text
    result = json.loads(outputs["json"].read_text())
    assert result["runs"] == 2 and result["finished"] == 0 and len(result["crashes"]) == 2
    for name in ("png", "gif"):
        with Image.open(outputs[name]) as image:
            assert image.size[0] > 300
