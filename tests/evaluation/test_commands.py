"""The subcommand evaluate, and the benchmark of speed."""

import json

import pytest
from PIL import Image

from benchmarks.speed import Job, measure
from quadjax.studies.ppo_against_sb3 import Clock, Side, curves_figure, format_sides
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


@pytest.mark.slow
def test_the_benchmark_measures_in_a_process(monkeypatch):
    monkeypatch.setattr("quadjax.studies.benchmark.STEPS_PER_CALL", 100)
    result = measure(Job("residual", "e2e", 2, 1))
    assert result["steps_per_second"] > 0 and result["devices"] == 2
    assert result["machine"]["cores"] >= 1


def test_the_speed_of_a_single_update_counts_from_the_start(monkeypatch):
    now = iter([20.0, 30.0, 35.0])
    monkeypatch.setattr("quadjax.studies.ppo_against_sb3.time.monotonic", lambda: next(now))
    clock = Clock(started=0.0, seconds=25.0)
    assert not clock.over(steps=1000) and clock.speed == 50.0 and clock.seconds == 20.0
    assert clock.over(steps=3000) and clock.speed == 200.0  # without the first: compilation
    assert clock.over(steps=4000) and clock.speed == 200.0


def test_both_sides_of_the_benchmark_end_at_the_same_steps_and_are_drawn(monkeypatch):
    monkeypatch.setattr("quadjax.studies.ppo_against_sb3.time.monotonic", lambda: 1.0)
    clock = Clock(started=0.0, seconds=9.0, steps=3000)
    assert not clock.over(2000) and clock.over(3000) and clock.steps == 3000
    curve = {"steps": [1e3, 2e3], "seconds": [1.0, 2.0], "reward": [0.0, 0.1]}
    sides = []
    for name, last in (("quadjax", 20.0), ("Stable-Baselines3", None)):
        own = curve | {"lap_total": [None, last]}
        sides.append(Side(name, "1 thread", 2.0, 3.0, 2000, 900.0, last, 6, 6, own))
    assert "20.00 s" in format_sides(sides, "") and "6 of 6" in format_sides(sides, "")
    drawn = [line.get_ydata() for axes in curves_figure(sides, "").axes for line in axes.lines]
    assert [20.0] in [data.tolist() for data in drawn if len(data) == 1]
