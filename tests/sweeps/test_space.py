"""Sweep files: what is refused in one line before anything runs, and what a grid holds."""

import subprocess
import sys

import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.sweeps.schema import load_sweep
from quadjax.sweeps.space import read_space, words_of
from tests.sweeps.support import ROOT, sweep_file


def space_of(**entries):
    tree = {key.replace("__", "."): value for key, value in entries.items()}
    return read_space(tree, "ppo", "s.yaml")


IMPOSSIBLE_SPACES = {
    "unknown key": ({"ppo.rate": {"range": [0, 1]}}, ["space.ppo.rate", "learning_rate"]),
    "unknown section": ({"pppo.clip": {"range": [0, 1]}}, ["space.pppo.clip", "unknown key"]),
    "below a leaf": ({"ppo.clip.low": {"range": [0, 1]}}, ["space.ppo.clip.low", "unknown"]),
    "a section": ({"ppo": {"range": [0, 1]}}, ["space.ppo", "section", "ppo.clip"]),
    "an empty range": ({"ppo.clip": {"range": [0.3, 0.3]}}, ["space.ppo.clip", "empty"]),
    "a range upside down": ({"ppo.clip": {"range": [0.3, 0.1]}}, ["[0.3, 0.1]", "empty"]),
    "no choices": ({"ppo.epochs": {"choices": []}}, ["space.ppo.epochs", "choices"]),
    "a choice twice": ({"ppo.epochs": {"choices": [3, 3]}}, ["3", "twice"]),
    "a word for a bound": ({"ppo.clip": {"range": ["a", 1]}}, ["space.ppo.clip", "two numbers"]),
    "three bounds": ({"ppo.clip": {"range": [0, 1, 2]}}, ["[0, 1, 2]", "two numbers"]),
    "not finite": ({"ppo.clip": {"range": [0.1, float("inf")]}}, ["two numbers"]),
    "half an epoch": ({"ppo.epochs": {"range": [1, 2.5]}}, ["2.5", "whole number"]),
    "half a step": ({"ppo.epochs": {"range": [1, 4], "step": 0.5}}, ["0.5", "whole number"]),
    "a log from zero": ({"ppo.clip": {"log": [0, 1]}}, ["log", "0", "positive"]),
    "a range of words": ({"network.activation": {"range": [0, 1]}}, ["network.activation"]),
    "a range of lists": ({"network.hidden": {"range": [1, 2]}}, ["network.hidden", "choices"]),
    "a plain value": ({"ppo.clip": 0.2}, ["space.ppo.clip", "0.2", "choices"]),
    "two ways": ({"ppo.clip": {"range": [0.1, 1], "log": [0.1, 1]}}, ["one of", "2"]),
    "an unknown way": ({"ppo.clip": {"range": [0.1, 1], "mean": 3}}, ["mean", "points"]),
    "a step of a log": ({"ppo.clip": {"log": [0.1, 1], "step": 0.1}}, ["step"]),
    "a step too long": ({"ppo.clip": {"range": [0.1, 1], "step": 2}}, ["step", "2"]),
    "one point": ({"ppo.clip": {"range": [0.1, 1], "points": 1}}, ["points", "1"]),
    "the seed": ({"seed": {"range": [0, 9]}}, ["space.seed", "itself"]),
    "the name": ({"name": {"choices": ["a"]}}, ["space.name", "itself"]),
    "the other learner": ({"shac.horizon": {"range": [8, 64]}}, ["shac.horizon", "ppo"]),
    "nothing": ({}, ["space"]),
    "a list": ([1], ["space"]),
}


@pytest.mark.parametrize("case", IMPOSSIBLE_SPACES)
def test_impossible_spaces(case):
    space, says = IMPOSSIBLE_SPACES[case]
    with pytest.raises(InputError) as caught:
        read_space(space, "ppo", "s.yaml")
    text = str(caught.value)
    assert all(part in text for part in [*says, "s.yaml"]) and "\n" not in text, text


def space(**entries):
    return {"space": {key.replace("__", "."): value for key, value in entries.items()}}


IMPOSSIBLE_FILES = {
    "beyond the schema": (space(ppo__discount={"range": [0.9, 1.2]}), ["ppo.discount", "1.2"]),
    "a wrong choice": (space(network__activation={"choices": ["gelu"]}), ["gelu", "relu"]),
    "a choice of a wrong type": (space(ppo__epochs={"choices": [2, "many"]}), ["many"]),
    "a truth for a number": (space(ppo__clip={"choices": [True]}), ["ppo.clip", "True"]),
    "what does not go together": (
        space(ppo__batches={"choices": [2, 4]}, train__drones={"choices": [16, 10]}),
        ["ppo.batches=4", "train.drones=10"],
    ),
    "an unknown entry": ({"serach": {}}, ["serach", "search"]),
    "an unknown method": ({"search": {"method": "magic"}}, ["search.method", "magic", "tpe"]),
    "no trials": ({"budget": {"trials": 0}}, ["budget.trials", "0"]),
    "half a trial": ({"budget": {"trials": 1.5}}, ["budget.trials"]),
    "no seeds": ({"objective": {"seeds": 0}}, ["objective.seeds", "0"]),
    "no penalty": ({"objective": {"missing_lap": -1}}, ["missing_lap", "-1"]),
    "no such config": ({"config": "none.yaml"}, ["none.yaml", "no such file"]),
    "no config": ({"config": ""}, ["config is missing"]),
    "another store": ({"storage": "mysql://u:secret@host/d"}, ["storage", "postgresql://"]),
    "a name with a slash": ({"name": "a/b"}, ["name", "a/b"]),
    "an unknown override": ({"overrides": {"ppo.klip": 1}}, ["overrides", "ppo.klip"]),
    "unknown conditions": ({"conditions": {"randomise.mass": 1}}, ["conditions", "mass"]),
    "a grid of a line": (
        {"search": {"method": "grid"}},
        ["ppo.learning_rate", "choices, a step or points"],
    ),
    "a grid with too few trials": (
        {
            "search": {"method": "grid"},
            **space(ppo__epochs={"range": [1, 5]}),
        },
        ["budget.trials is 4", "5 points"],
    ),
    "a base that the space is without": (
        {"search": {"base_first": True}, **space(ppo__clip={"range": [0.3, 0.4]})},
        ["space.ppo.clip", "0.2", "base_first"],
    ),
    "a base's choice that the space is without": (
        {"search": {"base_first": True}, **space(network__hidden={"choices": [[9]]})},
        ["space.network.hidden", "[8]", "base_first"],
    ),
    "a grid with the base first": (
        {"search": {"method": "grid", "base_first": True}, **space(ppo__epochs={"range": [1, 4]})},
        ["search.base_first", "grid"],
    ),
    "pruning of a race to a target": (
        {"search": {"pruner": "median"}, "objective": {"measure": "seconds_to"}},
        ["search.pruner", "seconds_to"],
    ),
}


@pytest.mark.parametrize("case", IMPOSSIBLE_FILES)
def test_impossible_sweeps(tmp_path, case):
    entries, says = IMPOSSIBLE_FILES[case]
    with pytest.raises(InputError) as caught:
        load_sweep(sweep_file(tmp_path, **entries))
    text = str(caught.value)
    assert all(part in text for part in says) and "\n" not in text, text
    assert "secret" not in text


def test_the_command_refuses_in_one_line_and_leaves_nothing(tmp_path):
    def refusal(*arguments):
        path = sweep_file(tmp_path, **space(ppo__rate={"range": [0, 1]}))
        command = [sys.executable, str(ROOT / "scripts/sweep.py"), str(path), *arguments]
        done = subprocess.run(
            [*command, "--output", str(tmp_path / "runs")],
            capture_output=True,
            text=True,
            cwd=ROOT,
            env={"PYTHONPATH": str(ROOT)},
        )
        assert done.returncode == 2 and not done.stdout
        assert not (tmp_path / "runs").exists()
        lines = done.stderr.splitlines()
        assert len(lines) == 1, lines
        return lines[0]

    assert "space.ppo.rate" in refusal()
    assert "--workers" in refusal("--workers", "0")
    assert "--vmap" in refusal("--vmap", "none")


def test_more_workers_than_cores_are_refused(tmp_path):
    from quadjax.sweeps import machine

    most = len(machine.own_cores())
    with pytest.raises(InputError, match=f"--workers is {most + 1}.*1 to {most}"):
        machine.choose_layout(most + 1, None, tmp_path, 1)
    layout = machine.choose_layout(None, None, tmp_path, 1)
    if not machine.accelerator_count():
        assert layout.workers == most and len(set(layout.cores)) == most and layout.lanes == 1


def test_what_was_measured_is_the_default(tmp_path):
    from quadjax.sweeps import machine

    speeds = {(1, 1): 3.0, (1, 4): 5.0, (1, 2): 4.0}
    rows = [
        {"workers": workers, "lanes": lanes, "runs_steps_per_second": speed}
        for (workers, lanes), speed in speeds.items()
    ]
    assert machine.write_calibration(tmp_path, rows)["lanes"] == 4
    layout = machine.choose_layout(None, None, tmp_path, 1)
    assert (layout.workers, layout.lanes) == (1, 4) and "measured" in layout.why
    assert machine.choose_layout(1, 2, tmp_path, 1).lanes == 2


def test_a_grid_holds_every_point(tmp_path):
    dimensions = space_of(
        ppo__clip={"range": [0.1, 0.3], "points": 3},
        ppo__learning_rate={"log": [1e-4, 1e-2], "points": 3},
        ppo__epochs={"range": [2, 6], "step": 2},
        network__hidden={"choices": [[8], [16, 16]]},
    )
    assert dimensions[0].grid() == pytest.approx([0.1, 0.2, 0.3])
    assert dimensions[1].grid() == pytest.approx([1e-4, 1e-3, 1e-2])
    assert dimensions[2].grid() == [2, 4, 6]
    assert dimensions[3].grid() == ["[8]", "[16, 16]"]
    params = {d.key: d.grid()[-1] for d in dimensions}
    config = load_config(ROOT / "configs/e2e_ppo.yaml", words_of(dimensions, params))
    assert config.network.hidden == [16, 16] and config.ppo.epochs == 6
    assert config.ppo.clip == 0.3 and config.ppo.learning_rate == 1e-2


def test_words_change_a_sweep(tmp_path):
    path = sweep_file(tmp_path)
    sweep = load_sweep(path, ["budget.trials=9", "space.ppo.clip.range=[0.2,0.4]", "name=other"])
    assert sweep.trials == 9 and sweep.file.name == "other"
    assert sweep.dimensions[1].low == 0.2
    config = sweep.config_of({"ppo.clip": 0.25, "ppo.learning_rate": 1e-3}, "t", 4)
    assert (config.ppo.clip, config.seed, config.name) == (0.25, 4, "t")
    assert config.train.drones == 16


def test_every_trial_is_judged_in_the_same_race(tmp_path):
    """Where the space varies the race itself, policies fly in the base's."""
    entries = space(
        randomise__thrust={"range": [0.0, 0.3]}, vehicle__motor__k_w={"range": [4e-8, 5e-8]}
    )
    sweep = load_sweep(sweep_file(tmp_path, **entries))
    base = load_config(sweep.base)
    judged = load_config(sweep.base, sweep.conditions)
    assert judged.randomise.thrust == 0.0
    assert judged.vehicle.motor["k_w"] == base.vehicle.motor["k_w"]
    sweep = load_sweep(sweep_file(tmp_path, **entries, conditions={"randomise.thrust": 0.1}))
    assert load_config(sweep.base, sweep.conditions).randomise.thrust == 0.1


@pytest.mark.parametrize(
    "path", sorted((ROOT / "configs/sweeps").glob("*.yaml")), ids=lambda p: p.stem
)
def test_every_shipped_sweep_can_run(path):
    assert load_sweep(path).trials >= 1
