"""Several seeds of one config: trained, flown, tabulated and drawn."""

import shlex

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import write_text
from quadjax.core.plotting import save_figure
from quadjax.core.resources import CONFIGS
from quadjax.evaluation.advice import before_training, next_step, wide_margin
from quadjax.evaluation.conditions import read_conditions
from quadjax.evaluation.curves import COLORS, learning_figure, spread, training_figure
from quadjax.evaluation.evaluate import evaluate
from quadjax.evaluation.result import Evaluation
from quadjax.evaluation.rows import Row
from quadjax.evaluation.training import (
    COLUMNS,
    evaluate_seed,
    format_seeds,
    load_configs,
    train_once,
    write_evaluation,
)
from quadjax.policy.file import Policy
from quadjax.training.result import Run, read_metrics
from quadjax.training.run import train
from tests.commands import run
from tests.evaluation.support import flights
from tests.surface.short import OF_EACH, OF_LEARNER, short_config

TINY = [*OF_EACH, *OF_LEARNER["ppo"]]
CONFIG = str(CONFIGS / "e2e_ppo.yaml")


@pytest.mark.slow
def test_a_seed_is_trained_once_and_not_passed_off_as_another(tmp_path):
    words = [*TINY, "seed=3", "name=mine"]
    folder = train_once(CONFIG, words, tmp_path)
    before = (folder / "summary.json").stat().st_mtime_ns
    assert train_once(CONFIG, words, tmp_path) == folder
    assert (folder / "summary.json").stat().st_mtime_ns == before
    with pytest.raises(InputError, match="discount"):
        train_once(CONFIG, [*words, "learner.discount=0.9"], tmp_path)
    with pytest.raises(InputError, match="other failed with status 2"):
        train_once(CONFIG, [*TINY, "name=other", "run.initial_policy=none.npz"], tmp_path)
    numbers, flown = evaluate_seed(folder, 2)
    assert numbers["seed"] == 3 and numbers["steps"] == 512
    assert [row.runs for row in flown.rows] == [2] * 4
    for table in format_seeds([(numbers, flown)]).split("\n\n")[:2]:
        assert len({line.count("|") for line in table.splitlines()}) == 1
    assert numbers["reference"] is None and "at s |" not in table  # one lap has no published time


@pytest.mark.slow
def test_a_training_that_is_scored_by_the_reward(tmp_path):
    run = train(short_config("e2e +hover", "evaluate.runs=3"), tmp_path, progress=False)
    rewards, summary = run.metrics["episode_reward"], run.summary
    assert len(set(rewards)) == 4 and "lap_total" not in run.metrics
    np.testing.assert_array_equal(
        run.metrics["best_episode_reward"], np.maximum.accumulate(rewards)
    )
    assert "best_lap_total" not in summary
    assert summary["best_episode_reward"] == pytest.approx(rewards.max(), abs=1e-3)
    assert summary["last_episode_reward"] == pytest.approx(rewards[-1], abs=1e-3)
    assert summary["best_steps"] == run.metrics["steps"][rewards.argmax()]
    text = write_evaluation(run)
    assert f"reward of an episode: best {summary['best_episode_reward']}" in text
    assert text.splitlines()[-1] == f"next: quadjax view {tmp_path} shows its flight"
    numbers, flown = evaluate_seed(tmp_path, 2)
    assert numbers["last"] == summary["last_episode_reward"] and [x.runs for x in flown.rows] == [2]
    axes = learning_figure({"hover": [tmp_path]}).axes
    assert axes[0].get_ylabel() == "reward of an episode"
    np.testing.assert_array_equal(axes[0].lines[0].get_ydata(), rewards)


def test_the_table_names_the_published_time():
    rows = (Row("seed 2", flights(2.0), "mean"),)
    flown = Evaluation(rows, read_conditions("protocols"), {"policy": {"file": "a"}}, True)
    numbers = dict.fromkeys(COLUMNS, 1e6) | {"reference": 17.14, "seed": 2, "last": None}
    head, _, row = format_seeds([(numbers, flown)]).split("\n\n")[0].splitlines()
    assert "<17.14 at s | at M steps | last |" in head
    assert row.startswith("| 2 | 1000000 | 1.0 | 1000000 | 1.0 | - | 1000000.00 |")


def test_configs_have_names_that_differ():
    files = [str(CONFIGS / name) for name in ("e2e_ppo.yaml", "indi_ppo.yaml")]
    assert list(load_configs(files, [])) == ["e2e_ppo", "indi_ppo"]
    assert list(load_configs(["e2e", "e2e +fastest name=other"], [])) == ["e2e", "other"]
    with pytest.raises(InputError, match="named mine"):
        load_configs(files, ["name=mine"])


NEXT = {  # by the width of the drone and the radius of its training, in the race of e2e +fastest
    ("0.34", "0"): "--body 0.17; train with rules.body_radius=0.17 rules.gate_test=interpolated",
    ("0", "0"): "--body RADIUS; train with rules.body_radius=RADIUS rules.gate_test=interpolated",
    ("0.01", "0"): "--conditions spread, or --plant; e2e_race_robust trains for these",
}


def smallest_clearance(flight):
    """Where straight lines between samples cross the planes of the gates, from the edges, m."""
    found = []
    for gate in flight.gates:
        forward, right, down = np.array(gate.axes).T
        place = flight["position"] - gate.position
        ahead, across = place @ forward, np.abs(np.stack([place @ right, place @ down], 1))
        for i in np.flatnonzero((ahead[:-1] < 0) & (ahead[1:] >= 0)):
            part = -ahead[i] / (ahead[i + 1] - ahead[i])
            inside = across[i] + part * (across[i + 1] - across[i])  # no sign changes near an edge
            found += [0.5 * gate.size[0] - inside.max()] if inside.max() < 0.6 else []
    return min(found)


@pytest.mark.slow
@pytest.mark.parametrize("numbers", NEXT)
def test_a_training_ends_with_what_its_flights_leave_and_what_to_run_next(numbers, tmp_path):
    width, radius = numbers
    changes = [f"vehicle.width={width}", f"rules.body_radius={radius}", "evaluate.laps=1"]
    config = load_config("e2e +fastest", [*changes, "rules.gate_test=interpolated"])
    summary = {"best_lap_total": 3.0, "best_steps": 500_000, "steps": 1_500_000, "devices": 1}
    run = Run(config, tmp_path, Policy.load("e2e_fastest"), True, summary | {"seconds": 1.0})
    head = "steps,seconds,lap_total,finished\n5e5,1,9,"
    write_text(tmp_path / "metrics.csv", f"{head}1\n1e6,2,9,0.9\n1e6,3,9,0.5\n1.5e6,4,9,0\n")
    last, clearance, command = write_evaluation(run).splitlines()[-3:]
    assert "only 90%, 50%, 0% of the flights finish; policy.npz is that of 0.5 million" in last
    flown = evaluate(run.policy, config, deterministic=True).flights
    known = f"half of the drone's width is {float(width) / 2:.2f} m"
    known = known if float(width) else "vehicle.width is not set"
    least = min(map(smallest_clearance, flown))
    assert 0 < least < 0.1
    assert clearance == f"smallest clearance of the deterministic flights: {least:.2f} m; {known}"
    assert command == f"next: quadjax evaluate --policy {tmp_path} {NEXT[numbers]}"
    write_text(tmp_path / "metrics.csv", f"{head}0\n" + "1e6,2,9,0.95\n" * 3)
    assert "at the end of the training" not in write_evaluation(run)


def test_a_margin_that_takes_most_of_an_opening():
    """Openings of 1 m, a mean leg of 3.5 m."""
    robust, body = load_config("e2e_race_robust"), ["rules.body_radius=0.16"]
    assert wide_margin(load_config("e2e_race", body)) == wide_margin(robust) == ""
    text = wide_margin(load_config("e2e_race_robust", body))
    assert text.startswith("reward.gate_edge_margin is 0.245 m, most of the 0.34 m from the center")
    assert wide_margin(load_config("e2e", body[:1])) == ""  # has no penalty at the edges


@pytest.mark.parametrize("margin", ["0.07 legs", "0.03 legs", "0.2"])
@pytest.mark.parametrize("opening", [0.7, 0.5, 0.37])
def test_a_margin_that_cannot_be_met_and_one_that_can(opening, margin):
    """The margin that is named is another one, of which nothing is said."""
    words = [f"track.opening={opening}", "rules.body_radius=0.16", "rules.gate_test=interpolated"]
    config = load_config("e2e_race_robust", [*words, f"reward.gate_edge_margin={margin}"])
    left, text = 0.5 * opening - 0.16, wide_margin(config)
    assert (text == "") == (config.reward.gate_edge_margin <= 0.5 * left)
    assert ("cannot be met" in text) == (config.reward.gate_edge_margin >= left)
    if text:
        named = text.split("; ")[1].split(" ")[0]
        assert before_training(load_config("e2e_race_robust", [*words, named])) == []


def test_a_gate_that_is_passed_against_a_leg_is_named_before_a_training(tmp_path):
    write_text(tmp_path / "back.yaml", GATES_OF_A_TURN)
    (line,) = before_training(load_config("e2e_race", [f"track={tmp_path}/back.yaml"]))
    assert line.startswith("back: ") and line.endswith("check yaw_deg of gate 2")
    assert before_training(load_config("e2e_race")) == []


def test_the_command_says_what_to_check_before_it_trains(tmp_path, monkeypatch, capsys):
    def stop(*_, **__):
        raise InputError("stopped")

    monkeypatch.setattr("quadjax.training.run.train", stop)
    write_text(tmp_path / "back.yaml", GATES_OF_A_TURN)
    words = (f"track={tmp_path}/back.yaml", "reward.gate_edge_margin=0.6")
    assert run("train", "e2e_race", *words, "--output", tmp_path) == 2
    against, margin, _ = capsys.readouterr().err.splitlines()
    assert "check yaw_deg of gate 2" in against
    assert "reward.gate_edge_margin is 0.6 m, cannot be met" in margin


GATES_OF_A_TURN = """
gates:
  - {position: [4, 0, -2], yaw_deg: 45}
  - {position: [4, 4, -2], yaw_deg: 315}
  - {position: [0, 4, -2], yaw_deg: 225}
  - {position: [0, 0, -2], yaw_deg: 315}
"""
AFTER = {  # the end of the next step, by the config of the run; its words make a config
    "e2e_race": "--conditions spread, or --plant; e2e_race_robust trains for these",
    "e2e_race vehicle=5inch": "--conditions spread; e2e_race_robust trains for these",
    "e2e_race_robust": "--conditions spread, or --plant; then quadjax export",
    "indi_race": "rules.body_radius=0.2 rules.gate_test=interpolated trains for these",
}


@pytest.mark.parametrize("preset", AFTER)
def test_the_next_step_is_a_setting_for_the_model_of_the_policy(preset, tmp_path):
    words = ["rules.body_radius=0.2", "rules.gate_test=interpolated"]
    config = load_config(preset, words)
    (line,) = next_step(Run(config, tmp_path, None, True, {}), [])
    assert line.startswith("next: quadjax evaluate --policy") and line.endswith(AFTER[preset])
    if "trains" in line:
        named = shlex.split(line.split("; ")[1].split(" trains")[0].replace("RADIUS", "0.2"))
        trained = load_config(named[0], [*named[1:], *preset.split()[1:]])
        assert trained.randomization.drawn and trained.vehicle.model == config.vehicle.model


def make_run(folder, times, seconds_each=10.0, config="e2e_ppo.yaml", overrides=()):
    """A run's folder with a row of metrics for each lap time, s."""
    write_text(folder / "config.yaml", load_config(CONFIGS / config, overrides).to_yaml())
    rows = [f"{500_000 * i},{seconds_each * i},{time}" for i, time in enumerate(times, 1)]
    write_text(folder / "metrics.csv", "\n".join(["steps,seconds,lap_total", *rows, ""]))
    return folder


def test_half_of_the_seeds_make_a_line_and_seeds_keep_their_latest_time():
    inf, nan = np.inf, np.nan
    along = [np.array([1.0, 2, 3, 4])] * 4
    times = [
        np.array([20.0, 18, 16, 14]),
        np.array([inf, 19, 17, 15]),
        np.array([inf, nan, 18, inf]),
        np.array([inf, inf, inf, inf]),
    ]
    wanted = (along[0], [nan, 19, 17.5, 15], [20, 18, 16, 14], [20, 19, 18, 15])
    np.testing.assert_array_equal(spread(along, times), wanted)
    np.testing.assert_array_equal(spread(along[:3], times[:3])[1], [nan, 19, 17, 15])
    seconds = [np.array([10.0, 20]), np.array([12.0, 30])]
    values = spread(seconds, [np.array([15.0, 14]), np.array([17.0, 16])])
    wanted = ([10, 12, 20, 30], [15, 16, 15.5, 15], [15, 15, 14, 14], [15, 17, 17, 16])
    np.testing.assert_array_equal(values, wanted)


def test_groups_are_drawn_and_published_times_next_to_their_race_only(tmp_path):
    overrides = ["run.score=sampled"]
    e2e = [make_run(tmp_path / f"a{i}", [np.inf, 16.0 + i, 15.0 + i]) for i in range(3)]
    indi = [make_run(tmp_path / "b", [20.0, 17.5, 17.0], 25.0, "indi_table1.yaml", overrides)]
    figure = learning_figure({"e2e": e2e, "indi": indi})
    wall, steps = figure.axes
    assert "wall time" in wall.get_xlabel() and "steps" in steps.get_xlabel()
    assert "6 laps" in wall.get_ylabel()
    assert not wall.texts  # e2e is another race than the published ones
    alone = learning_figure({"indi": indi}).axes[0]
    assert [text.get_text() for text in alone.texts] == ["Table I, INDI simulated, sampled"]
    other = make_run(tmp_path / "c", [20.0, 17.5], 25.0, "indi_ppo.yaml", overrides)
    assert not learning_figure({"indi": [*indi, other]}).axes[0].texts
    curves = {line.get_label(): line for line in steps.lines}
    assert list(curves) == ["e2e (3 seeds, mean action)", "indi (1 seed, sampled)"]
    drawn = curves["e2e (3 seeds, mean action)"]
    assert drawn.get_xdata().tolist() == [0.5, 1.0, 1.5]
    np.testing.assert_array_equal(drawn.get_ydata(), [np.nan, 17, 16])
    assert wall.lines[1].get_xdata().tolist() == [25, 50, 75]
    assert wall.lines[0].get_color() == steps.lines[0].get_color() != wall.lines[1].get_color()
    layout, files = figure.get_layout_engine(), [tmp_path / f"curves.{x}" for x in ("png", "no")]
    with pytest.raises(InputError, match="curves.no: suffix is 'no', allowed"):
        save_figure(figure, *files)
    assert files[0].exists() and figure.get_layout_engine() is layout


def test_runs_that_never_finish_or_cannot_be_compared(tmp_path):
    six, two = (
        make_run(tmp_path / str(n), [np.inf, np.inf], overrides=[f"evaluate.laps={n}"])
        for n in (6, 2)
    )
    axes = learning_figure({"two": [two]}).axes[0]
    assert [text.get_text() for text in axes.texts] == ["no run completed its laps"]
    assert "2 laps" in axes.get_ylabel()
    bad = make_run(tmp_path / "bad", [20.0])
    write_text(bad / "metrics.csv", "steps,lap_total\n1,2\n")
    for groups, says in (
        ({"six": [six], "two": [two]}, "six 6 laps, two 2 laps"),
        ({"bad": [bad]}, "metrics.csv: no column seconds"),
        ({"none": []}, "no runs"),
        ({str(i): [six] for i in range(len(COLORS) + 1)}, "allowed: 1 to"),
    ):
        with pytest.raises(InputError, match=says):
            learning_figure(groups)


def test_training_curves_have_the_columns_of_a_metrics_file(tmp_path):
    path = tmp_path / "metrics.csv"
    rows = [f"{i},{0.5 * i},{i / 10},{'inf' if i < 4 else 20 - i}" for i in range(1, 6)]
    path.write_text("\n".join(["steps,seconds,reward,lap_total", *rows, "60"]))
    metrics = read_metrics(path)
    assert metrics["steps"].tolist() == [1, 2, 3, 4, 5]
    panels = training_figure({"run": metrics}, "run", ("published", 15.75)).axes
    assert [axes.get_ylabel() for axes in panels[::2]] == ["reward per step", "score: all laps (s)"]
    np.testing.assert_allclose(panels[3].lines[0].get_data(), [[4e-6, 5e-6], [16, 15]])
    assert [text.get_text() for text in panels[3].texts] == ["published"]
    no_laps = metrics | {"lap_total": np.full(5, np.inf)}
    del no_laps["seconds"]
    assert len(training_figure({"run": no_laps}).axes) == 1
    for columns, says in (({"steps": metrics["steps"]}, "steps"), ([], "none")):
        with pytest.raises(InputError, match=f"columns {says}; expected one of seconds"):
            training_figure({"run": columns})
    for text, says in (
        ("", "no rows"),
        ("steps,reward\n1,x\n", "line 2: '1,x'"),
        ("a,b\n1\n3,4\n", "line 2: '1', expected 2 numbers"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=says):
            read_metrics(path)
