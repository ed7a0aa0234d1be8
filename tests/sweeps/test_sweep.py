"""Sweep files: what is refused in one line before anything runs, and what a grid holds."""

import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.yaml_files import parse_yaml, to_yaml
from quadjax.sweeps.sweep import load_sweep
from tests.commands import run
from tests.sweeps.stand_in import CLIP, RATE, ROOT, TINY, sweep_file

EPOCHS, HIDDEN = "learner.num_epochs", "network.hidden"


def space(entries):
    return {"space": entries}


# Changes of the small sweep, and words of the error.
REFUSED = """
space: {learner.rate: {range: [0, 1]}} | space.learner.rate learning_rate
space: {learner: {range: [0, 1]}} | space.learner section clip
space: {learner.clip_range: {range: [0.4, 0.3]}} | space.learner.clip_range 0.4 0.3
space: {learner.num_epochs: {choices: []}} | space.learner.num_epochs choices
space: {learner.num_epochs: {choices: [3, 3]}} | 3 twice
space: {learner.clip_range: {range: [a, 1]}} | space.learner.clip_range range
space: {learner.clip_range: {range: [0.1, 1e+99]}} | clip_range 1e+99
space: {learner.num_epochs: {range: [1, 2.5]}} | 2.5 whole
space: {learner.clip_range: {log: [0, 1]}} | space.learner.clip_range log
space: {network.activation: {range: [0, 1]}} | network.activation choices
space: {learner.clip_range: 0.2} | space.learner.clip_range 0.2 mapping
space: {learner.clip_range: {range: [0.1, 1], log: [0.1, 1]}} | one of 2
space: {learner.clip_range: {log: [0.1, 1], step: 0.1}} | step
space: {seed: {range: [0, 9]}} | space.seed set by the sweep
space: {} | space
space: {learner.discount: {range: [0.9, 1.2]}} | discount 1.2
space: {learner.clip_range: {choices: [true]}} | learner.clip_range true
space: {learner.num_minibatches: {choices: [2, 4]}, learner.num_envs: {choices: [16, 10]}} \
    | learner.num_minibatches=4 learner.num_envs=10
serach: {} | serach search
search: {method: magic} | search.method magic tpe
objective: {runs: 1000000000} | objective.runs
objective: {runs: 10, plant: standin, plants: 3} | objective.runs 10 multiples (3)
objective: {plant: stanndin} | stanndin
config: none.yaml | config none.yaml file
storage: mysql://u:secret@host/d | storage postgresql://
name: a/b | name a/b
overrides: {ppo.klip: 1} | ppo
search: {method: grid} | learner.learning_rate choices, step or points
{search: {method: grid}, space: {learner.num_epochs: {range: [1, 5]}}} | 5 points budget.trials: 4
{search: {method: grid}, budget: {}, space: {learner.clip_range: {range: [0.1, 0.3], step: 1e-9}}} \
    | points 10000
{search: {base_first: true}, space: {learner.clip_range: {range: [0.3, 0.4]}}} | 0.2 base_first
{search: {method: grid, base_first: true}, space: {learner.num_epochs: {range: [1, 4]}}} \
    | search.base_first grid
"""


def test_impossible_sweeps(tmp_path):
    for line in REFUSED.replace("\\\n", "").strip().splitlines():
        entries, _, words = line.partition(" | ")
        with pytest.raises(InputError) as caught:
            load_sweep(sweep_file(tmp_path, **parse_yaml(entries, "case")))
        text = str(caught.value)
        assert all(word in text for word in [*words.split(), "small.yaml"]), (line, text)
        assert "\n" not in text and "secret" not in text


def test_the_command_refuses_in_one_line_and_leaves_nothing(tmp_path, capsys):
    path = sweep_file(tmp_path, **space({"learner.rate": {"range": [0, 1]}}))
    assert run("sweep", path, "--output", tmp_path / "runs") == 2
    printed = capsys.readouterr()
    assert not printed.out and not (tmp_path / "runs").exists()
    assert len(printed.err.splitlines()) == 1 and "space.learner.rate" in printed.err
    assert run("sweep", sweep_file(tmp_path), "--check", "--output", tmp_path / "runs") == 0
    assert "4 trials of 1 seeds" in capsys.readouterr().out and not (tmp_path / "runs").exists()


def test_a_grid_holds_every_point(tmp_path):
    given = {
        CLIP: {"range": [0.1, 0.3], "points": 3},
        RATE: {"log": [1e-4, 1e-2], "points": 3},
        EPOCHS: {"range": [2, 6], "step": 2},
        HIDDEN: {"choices": [[8], [16, 16]]},
    }
    sweep = load_sweep(sweep_file(tmp_path, search={"method": "grid"}, budget={}, **space(given)))
    grid = sweep.grid()
    assert grid[CLIP] == pytest.approx([0.1, 0.2, 0.3])
    assert grid[RATE] == pytest.approx([1e-4, 1e-3, 1e-2])
    assert grid[EPOCHS] == [2, 4, 6] and grid[HIDDEN] == ["[8]", "[16, 16]"]
    points = [tuple(params.values()) for params in sweep.queue()]
    assert len(points) == len(set(points)) == sweep.trials == 54
    config = sweep.config_of({key: values[-1] for key, values in grid.items()})
    assert list(config.network.hidden) == [16, 16] and config.learner.num_epochs == 6
    assert config.learner.clip_range == 0.3 and config.learner.learning_rate == 1e-2


def test_overrides_change_a_sweep(tmp_path):
    changes = ["budget.trials=9", f"space.{CLIP}.range=[0.2,0.4]", "name=other"]
    sweep = load_sweep(sweep_file(tmp_path), [*changes, "overrides.learner.num_epochs=2"])
    assert sweep.trials == 9 and sweep.file.name == "other"
    assert (sweep.space[CLIP].low, sweep.space[CLIP].high) == (0.2, 0.4)
    config = sweep.config_of({CLIP: 0.25, RATE: 1e-3}, "name=t", "seed=4")
    learner = config.learner
    assert (learner.clip_range, learner.num_epochs, learner.num_envs) == (0.25, 2, 16)
    assert (config.seed, config.name) == (4, "t")


def test_every_trial_is_evaluated_in_the_same_race(tmp_path):
    """Where the space varies the race itself, policies fly in the base's."""
    varied = {
        "randomization.thrust": {"range": [0.0, 0.3]},
        "start.position": {"range": [0.1, 1.0]},
    }
    sweep = load_sweep(sweep_file(tmp_path, **space(varied)))
    base = load_config(sweep.base)
    race = sweep.config_of({"randomization.thrust": 0.3, "start.position": 1.0}, *sweep.conditions)
    assert race.randomization.thrust == 0.0 and race.start.position == base.start.position
    entries = space(varied) | {"conditions": {"randomization": {"thrust": 0.1}}}
    sweep = load_sweep(sweep_file(tmp_path, **entries))
    race = sweep.config_of({"randomization.thrust": 0.3, "start.position": 1.0}, *sweep.conditions)
    assert race.randomization.thrust == 0.1


def test_the_base_config_is_found_by_the_name_of_a_preset(tmp_path):
    path = sweep_file(tmp_path, config="e2e_ppo")
    assert load_sweep(path).config_of({CLIP: 0.2, RATE: 1e-3}).learner.algorithm == "ppo"
    base = str(ROOT / "configs/e2e_ppo.yaml")
    (tmp_path / "own.yaml").write_text(to_yaml({"base": base, "learner": {"num_epochs": 7}}))
    own = {key: value for key, value in TINY.items() if key != "learner"}
    path = sweep_file(tmp_path, config="own.yaml", overrides=own)
    assert load_sweep(path).config_of({CLIP: 0.2, RATE: 1e-3}).learner.num_epochs == 7
