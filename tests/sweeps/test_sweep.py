"""Sweep files, their studies, a real trial, and the report."""

import csv
import itertools
import math
import signal
import sys
import threading
import warnings
from threading import Event
from types import SimpleNamespace

import numpy as np
import optuna
import pytest
from PIL import Image

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.yaml_files import parse_yaml, to_yaml
from quadjax.sweeps.figures import figures
from quadjax.sweeps.report import write_report
from quadjax.sweeps.run import (
    TrialStopped,
    objective,
    run_sweep,
    train_and_fly,
    training,
    work,
)
from quadjax.sweeps.study import (
    FILE,
    Grid,
    State,
    delete_study,
    drop_partial_line,
    is_beyond,
    load_study,
    number_of,
    open_study,
    retry,
    retry_running,
    trials_left,
    trials_over,
    without_secrets,
)
from quadjax.sweeps.sweep import load_sweep
from tests.commands import run
from tests.evaluation.support import flights
from tests.sweeps.stand_in import CLIP, RATE, ROOT, TINY, complete, open_small, sweep_file, value_of

EPOCHS, HIDDEN = "learner.num_epochs", "network.hidden"

# Changes of the small sweep, and words of the error.
REFUSED = """
space: {learner.rate: {range: [0, 1]}} | space.learner.rate learning_rate
space: {learner: {range: [0, 1]}} | space.learner section clip
space: {learner.clip_range: {range: [0.4, 0.3]}} | space.learner.clip_range 0.4 0.3
space: {learner.num_epochs: {choices: []}} | space.learner.num_epochs choices
space: {learner.clip_range: {range: [a, 1]}} | space.learner.clip_range range
space: {learner.clip_range: {range: [0.1, 1e+99]}} | clip_range 1e+99
space: {learner.num_epochs: {range: [1, 2.5]}} | 2.5 whole
space: {learner.clip_range: {log: [0, 1]}} | space.learner.clip_range log
space: {network.activation: {range: [0, 1]}} | network.activation 'relu' choices
space: {learner.clip_range: 0.2} | space.learner.clip_range 0.2 mapping
space: {learner.clip_range: {range: [0.1, 1], log: [0.1, 1]}} | one of 2
space: {learner.clip_range: {log: [0.1, 1], step: 0.1}} | step
space: {seed: {range: [0, 9]}} | space.seed set by the sweep
space: {} | space
space: {learner.discount: {rang: [0.9, 0.99]}} | learner.discount.rang mapping choices range log
space: {learner.discount: {range: [0.99, 0.9]}} | learner.discount: range [0.99 [lowest, highest]
space: {learner.learning_rate: {log: [0, 0.1]}} | log [0.0, 0.1] [lowest, highest] above 0
space: {learner.discount: {range: [0.9, 0.99], step: 1}} | step 1 divisor 0.09
space: {learner.num_epochs: {range: [1, 10], step: 4}} | step 4 divisor 9
space: {learner.discount: {range: [0.9, 1.2]}} | discount 1.2
space: {learner.clip_range: {choices: [true]}} | learner.clip_range true
space: {learner.num_minibatches: {choices: [2, 4]}, learner.num_envs: {choices: [16, 10]}} \
    | learner.num_minibatches=4 learner.num_envs=10
serach: {} | serach search
search: {method: magic} | search.method magic tpe
objective: {runs: 1000000000} | objective.runs
objective: {runs: 10, plant: standin, drones: 3} | objective.runs 10 multiples (3)
objective: {plant: stanndin} | stanndin
config: none.yaml | config none.yaml file
storage: study.db | storage 'study.db' journal URL
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
        assert "\n" not in text


def test_the_command_refuses_in_one_line_without_a_password_and_leaves_nothing(
    tmp_path, capfd, monkeypatch
):
    monkeypatch.setitem(sys.modules, "MySQLdb", None)  # the driver of mysql://
    runs = tmp_path / "runs"
    path = sweep_file(tmp_path, space={"learner.rate": {"range": [0, 1]}})
    assert run("sweep", path, "--output", runs) == 2
    printed = capfd.readouterr()
    assert len(printed.err.splitlines()) == 1 and "space.learner.rate" in printed.err
    for url, problem in (
        ("sqlite://me:s3cret@host/none", "Invalid SQLite URL"),
        ("sqlite://me:7/s3cret@host/none", "Invalid SQLite URL"),
        (f"sqlite:///{tmp_path}/none.db?timeout=s3cret", "could not convert string to float"),
        (f"sqlite:///{tmp_path}/nowhere/none.db", "unable to open database file"),
        ("mysql://me:s3cret@host/none", "MySQLdb"),
        ("mysql://me:s3cret@host/none", "; install the driver that the storage URL names)"),
        ("nonsense://me:s3cret@host/none", "nonsense"),
    ):
        assert run("sweep", sweep_file(tmp_path, storage=url), "--output", runs) == 2
        printed = capfd.readouterr()
        assert len(printed.err.splitlines()) == 1 and problem in printed.err
        assert "storage cannot be used" in printed.err
        assert not printed.out.count("s3cret") and "s3cret" not in printed.err
    assert run("sweep", path, "executor=postgresql://bob:s3cret@h/db", "--output", runs) == 2
    assert "://bob:***@h/db" in capfd.readouterr().err  # of another key
    assert run("sweep", sweep_file(tmp_path), "--report", "--output", runs) == 2
    assert "no trials of the sweep small; run it first" in capfd.readouterr().err
    assert run("sweep", sweep_file(tmp_path), "--check", "--output", runs) == 0
    assert "4 trials of 1 seed can run" in capfd.readouterr().out and not runs.exists()


@pytest.mark.parametrize(
    ("url", "text", "wanted"),
    [
        ("mysql://me:7/s3cret@h/db", "at 127.0.0.1:37, 7", "at 127.0.0.1:37, ***"),
        ("mysql://me:7/s3cret@h/db", "no host 'me:7', s3cret.", "no host 'me:***', ***."),
        ("mysql://me:a@h/db?timeout=1", "a bad 127.0.0.1: 1", "*** bad 127.0.0.1: ***"),
        ("mysql://me:p%40ss%2F!@h/db", "p@ss/! or p%40ss%2F!", "*** or ***"),
        ("sqlite:///a.db", "a.db at 127.0.0.1", "a.db at 127.0.0.1"),
    ],
)
def test_a_password_is_hidden_and_no_part_of_another_word(url, text, wanted):
    assert without_secrets(text, url) == wanted


def test_a_grid_holds_every_point_and_overrides_change_a_sweep(tmp_path):
    space = {
        CLIP: {"range": [0.1, 0.3], "points": 3},
        RATE: {"log": [1e-4, 1e-2], "points": 3},
        EPOCHS: {"range": [2, 6], "step": 2},
        HIDDEN: {"choices": [[8], [16, 16]]},
    }
    path = sweep_file(tmp_path, search={"method": "grid"}, budget={}, space=space)
    sweep = load_sweep(path)
    grid = sweep.grid()
    assert grid[CLIP] == pytest.approx([0.1, 0.2, 0.3])
    assert grid[RATE] == pytest.approx([1e-4, 1e-3, 1e-2])
    assert grid[EPOCHS] == [2, 4, 6] and grid[HIDDEN] == ["[8]", "[16, 16]"]
    assert sweep.trials == 54
    config = sweep.make_config({key: values[-1] for key, values in grid.items()}, "seed=4")
    assert list(config.network.hidden) == [16, 16] and config.learner.num_epochs == 6
    assert config.learner.clip_range == 0.3 and config.learner.learning_rate == 1e-2
    changes = ["search.method=tpe", "budget.trials=9", f"space.{CLIP}={{range: [0.2, 0.4]}}"]
    sweep = load_sweep(path, [*changes, "overrides.learner.num_epochs=2", "name=other"])
    assert sweep.trials == 9 and sweep.file.name == "other" and sweep.space[CLIP].high == 0.4
    assert sweep.make_config({CLIP: 0.25}).learner.num_envs == config.seed * 4 == 16


def test_the_base_is_a_preset_or_a_file_and_every_trial_is_evaluated_in_its_race(tmp_path):
    varied = {
        "randomization.thrust": {"range": [0.0, 0.3]},
        "start.position": {"range": [0.1, 1.0]},
    }
    sweep = load_sweep(sweep_file(tmp_path, space=varied, config="e2e_ppo"))
    params = {"randomization.thrust": 0.3, "start.position": 1.0}
    race, base = sweep.make_config(params, *sweep.conditions), load_config(sweep.base)
    assert race.randomization.thrust == 0.0 and race.start.position == base.start.position
    assert race.learner.algorithm == "ppo"
    conditions = {"randomization": {"thrust": 0.1}}
    sweep = load_sweep(sweep_file(tmp_path, space=varied, conditions=conditions))
    assert sweep.make_config(params, *sweep.conditions).randomization.thrust == 0.1
    tree = {"base": str(ROOT / "configs/e2e_ppo.yaml"), "learner": {"num_epochs": 7}}
    (tmp_path / "mine.yaml").write_text(to_yaml(tree))
    changes = {key: value for key, value in TINY.items() if key != "learner"}
    path = sweep_file(tmp_path, config="mine.yaml", overrides=changes)
    assert load_sweep(path).make_config({CLIP: 0.2, RATE: 1e-3}).learner.num_epochs == 7


def test_a_study_takes_only_its_own_sweep_and_damage_is_one_line(tmp_path):
    sweep, directory, study = open_small(tmp_path)
    assert trials_left(study, sweep) == 4
    larger, _, study = open_small(tmp_path, "budget.trials=6")
    assert trials_left(study, larger) == 6
    for change, message in (
        ("objective.seeds=2", r"objective.seeds was 1, is 2"),
        (f"space.{CLIP}.range=[0.1,0.4]", r"space.learner.clip_range was .*0.3.* is .*0.4"),
        ("overrides.learner.discount=0.9", r"config.*discount was 0.99.*, is 0.9"),
    ):
        with pytest.raises(InputError, match=message):
            open_small(tmp_path, change)
    whole = (directory / FILE).read_bytes()
    for damage in (b"[]\n" + whole, whole.replace(b"\n", b"\x00\xff\n"), b"{}\n" + whole):
        (directory / FILE).write_bytes(damage)
        with pytest.raises(InputError, match=r"study.journal is damaged.*--overwrite") as caught:
            open_study(sweep, directory)
        assert "\n" not in str(caught.value)


def test_a_storage_url_is_passed_to_optuna(tmp_path):
    storage = f"sqlite:///{tmp_path}/study.db"
    sweep, directory, study = open_small(tmp_path, storage=storage)
    ended(study, sweep, value_of, finished=1.0)
    assert optuna.load_study(study_name="small", storage=storage).trials == study.trials
    assert load_study(sweep, directory).best_value == study.best_value
    assert not (directory / FILE).exists()
    delete_study(sweep, directory)
    with pytest.raises(InputError, match="no trials of the sweep small"):
        load_study(sweep, directory)


def test_a_line_without_an_end_is_dropped_by_a_sweep_and_left_by_a_report(tmp_path):
    sweep, directory, study = open_small(tmp_path)
    study.ask()
    journal = directory / FILE
    journal.write_bytes(before := journal.read_bytes() + b'{"op_code": 6, "tri')
    assert len(load_study(sweep, directory).trials) == 1 and journal.read_bytes() == before
    drop_partial_line(directory)
    study = open_study(sweep, directory)
    study.ask()
    assert len(study.trials) == 2


def test_a_sweep_says_how_far_its_running_trials_are(tmp_path):
    """Of two seeds with ten reports each."""
    sweep, _, study = open_small(tmp_path, objective={"seeds": 2})
    assert training(study, sweep) == "starting the workers"
    first, _ = study.ask(sweep.space), study.ask(sweep.space)
    first.report(12.0, 5)
    assert training(study, sweep) == "training: trial 0 25%, trial 1 0%"


def test_an_interrupted_trial_is_queued_again(tmp_path):
    sweep, directory, study = open_small(tmp_path)

    def interrupt(*_):
        raise KeyboardInterrupt

    work(sweep, directory, interrupt, math.inf, 0, "worker")
    first, second = study.trials
    assert (first.state, second.state) == (State.FAIL, State.WAITING)
    assert trials_over(study) == [] and number_of(second) == first.number


def test_only_deaths_of_a_worker_use_up_the_retries_of_a_trial(tmp_path):
    _, _, study = open_small(tmp_path)
    for retries, queued in ((None, 1), (None, 1), (1, 1), (None, 1), (1, 0)):
        study.ask()
        retry_running(study, retries)
        assert len(study.get_trials(states=(State.WAITING,))) == queued
    assert [trial.number for trial in trials_over(study)] == [4]


def test_a_trial_that_another_worker_made_superfluous_is_not_run(tmp_path, monkeypatch):
    """Another one begins the last trial between the look at the budget and the own beginning."""
    looks = iter([1])
    monkeypatch.setattr(
        "quadjax.sweeps.run.trials_left", lambda *x: next(looks, None) or trials_left(*x)
    )
    sweep, directory, study = open_small(tmp_path, "budget.trials=1")
    other = study.ask()
    work(sweep, directory, None, math.inf, 0, "worker")
    assert len(study.trials) == 2 and trials_over(study) == []
    sweep.suggest(other)
    study.tell(other, 9.0)
    larger, _, _ = open_small(tmp_path, "budget.trials=2")
    assert trials_left(study, larger) == 1
    work(larger, directory, lambda *_: (8.0, 1.0), math.inf, 0, "worker")
    assert [trial.value for trial in complete(study)] == [9.0, 8.0]
    assert trials_left(study, larger) == 0


def test_a_trial_that_two_machines_queue_again_is_run_once(tmp_path):
    sweep, directory, study = open_small(tmp_path, "budget.trials=1")
    study.tell(study.ask(), state=State.FAIL)
    for _ in range(2):
        retry(study, study.trials[0], 1)
    work(sweep, directory, lambda *_: (8.0, 1.0), math.inf, 0, "worker")
    assert [trial.number for trial in trials_over(study)] == [1]
    study.ask()
    assert is_beyond(study, 2, 1)


def test_a_grid_has_each_point_once_also_where_trials_begin_together(tmp_path):
    space = {CLIP: {"choices": [0.1, 0.2, 0.3]}, EPOCHS: {"range": [1, 2]}}
    grid = {"search": {"method": "grid"}, "budget": {}, "space": space}
    sweep, directory, _ = open_small(tmp_path, **grid)
    studies = [open_study(sweep, directory, slot) for slot in range(2)]
    begun = [study.ask() for _ in range(3) for study in studies]
    again = begun.pop(1)  # its worker dies before it draws the point
    studies[0].tell(again, state=State.FAIL)
    retry(studies[0], studies[0].trials[1])
    begun.append(studies[1].ask())
    points = {tuple(sweep.suggest(trial).values()) for trial in reversed(begun)}
    assert len(points) == 6 == sweep.trials


def test_processes_that_open_one_new_database_at_the_same_time_all_open_it(tmp_path):
    storage, opened = f"sqlite:///{tmp_path}/study.db", []
    together = threading.Barrier(3)
    sweeps = [load_sweep(sweep_file(tmp_path / f"{k}", storage=storage)) for k in range(3)]

    def begin(sweep):
        together.wait()
        opened.append(open_study(sweep, tmp_path).study_name)

    threads = [threading.Thread(target=begin, args=(sweep,)) for sweep in sweeps]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert opened == ["small"] * 3


def test_an_interrupted_sweep_stops_each_worker_once(tmp_path):
    sweep, directory, _ = open_small(tmp_path)
    stops, polls = [], iter([None, None, None, ""])
    workers = SimpleNamespace(
        count=1,
        start=lambda *_: signal.raise_signal(signal.SIGINT),
        stop=stops.append,
        reason=lambda worker: next(polls),
    )
    assert not run_sweep(sweep, directory, workers, measure=None)
    assert len(stops) == 1


@pytest.mark.slow
def test_a_trial_resumes_its_training_and_reports_to_the_pruner(tmp_path):
    search = {"method": "random", "pruner": "median"}
    sweep, directory, study = open_small(tmp_path, search=search, objective={"seeds": 2, "runs": 2})
    stops = []

    def measure(sweep, params, seed, folder, stop_when):
        def stop_once(fraction, value):
            stops.append(fraction)
            return stop_when(fraction, value) or len(stops) == 2

        return train_and_fly(sweep, params, seed, folder, stop_once)

    trial = study.ask()
    with pytest.raises(TrialStopped):
        objective(trial, sweep, directory, measure, Event())
    assert trial.user_attrs["values"] == [] and stops == [0.25, 0.5]
    assert objective(trial, sweep, directory, measure, Event()) == 8.0  # the limit of the one lap
    assert trial.user_attrs["values"] == [8.0, 8.0] and trial.user_attrs["finished"] == 0.0
    assert stops[2:] == [0.75, 1.0, 0.25, 0.5, 0.75, 1.0]
    assert [*study.trials[0].intermediate_values] == [2, 5, 7, 10, 12, 15, 17, 20]


@pytest.mark.slow
def test_a_trial_is_evaluated_on_drawn_plants(tmp_path, monkeypatch):
    flown = []

    def fly(policy, race, *, plant, drones, runs, **_):
        flown.append((runs, drones, plant, race.vehicle.model))
        laps = flights(*[5.0, np.nan] * 3, laps=1)
        return SimpleNamespace(laps=laps, finished=laps.finished)

    monkeypatch.setattr("quadjax.evaluation.evaluate.evaluate", fly)
    plant = {"seeds": 1, "runs": 6, "plant": "standin", "drones": 2}
    sweep, directory, _ = open_small(tmp_path, objective=plant)
    params, folder = {CLIP: 0.2, RATE: 1e-3}, directory / "trials/0000/seed0"
    value = train_and_fly(sweep, params, 0, folder, lambda fraction, value: False)
    assert flown == [(6, 2, "standin", "motor")]
    assert value == (6.5, 0.5)  # 5 s, and the limit of 8 s


def test_a_lap_that_is_not_completed_counts_its_share_of_the_time_limit():
    assert flights(5.0).penalized == 5.0
    assert flights(5.0, np.nan, before=1).penalized == (5.0 + 2.5 + 8.0) / 2
    assert flights(np.nan).penalized == 16.0


def ended(study, sweep, value=None, **attributes):
    """Add a trial that was evaluated, or that failed if there is no value."""
    trial = study.ask()
    params = sweep.suggest(trial)
    for name, item in attributes.items():
        trial.set_user_attr(name, item)
    state = None if value else State.FAIL
    study.tell(trial, value(params) if value else None, state=state)


def test_the_report_has_a_table_figures_and_the_best_config(tmp_path):
    """Of thirty trials; one failed, one is without a finished flight."""
    hidden = {HIDDEN: {"choices": [[8], [16, 16]]}}
    space = {CLIP: {"range": [0.1, 0.3]}, RATE: {"log": [1e-4, 1e-2]}} | hidden
    sweep, directory, study = open_small(tmp_path, space=space, budget={"trials": 30})
    numbers = {"finished": 1.0, "seconds": 1.5, "host": "here", "values": [1.0]}
    ended(study, sweep, lambda _: 48.0, **numbers | {"finished": 0.0})
    text = write_report(study, sweep, directory)
    assert "No policy finished a flight" in text and not (directory / "best.yaml").exists()
    ended(study, sweep, error="not enough memory")
    for _ in range(28):
        ended(study, sweep, value_of, **numbers)
    text = write_report(study, sweep, directory)
    with open(directory / "trials.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    values = [float(row["median"]) for row in rows[:-1]]
    assert len(rows) == 30 and values == sorted(values) and values[-1] == 48.0
    assert rows[-1]["error"] == "not enough memory" and "[16, 16]" in str(rows)
    assert values[0] == pytest.approx(min(t.value for t in complete(study)), abs=1e-3)
    assert "best.yaml" in text and rows[0]["median"] in text
    config = load_config(directory / "best.yaml")
    assert config.learner.clip_range == pytest.approx(float(rows[0][CLIP]), rel=1e-3)
    assert config.name == "small_best" and config.run.devices == "auto"
    for name in ("parallel.png", "slices.png", "importances.png"):
        with Image.open(directory / name) as image:
            assert image.size[0] > 600 and len(set(image.convert("L").tobytes())) > 20


SPACE = {
    RATE: {"log": [1e-3, 1e-2]},
    "learner.gae_lambda": {"range": [0.9, 0.995]},
    "learner.max_grad_norm": {"log": [0.0135, 0.0142]},
    EPOCHS: {"range": [2, 8], "step": 2},
    HIDDEN: {"choices": [[48, 48], [64, 64, 64], [128, 128, 128, 128]]},
    "learner.max_kl": {"choices": [None, 0.02]},
}


@pytest.mark.parametrize("count", [1, 4, 6])
def test_the_figures_of_any_space_can_be_read(tmp_path, count):
    """Names and numbers are whole and do not cover each other; the best trial is marked."""
    space = dict(list(SPACE.items())[:count])
    sweep, directory, study = open_small(tmp_path, space=space)
    for _ in range(9):
        ended(study, sweep, lambda params: 10.0 + params[RATE] * 100, finished=1.0)
    trials = complete(study)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        drawn = figures(trials, "small: e2e_ppo, Parrot Bebop 1, square4")
    assert set(drawn) == {"slices", "parallel", *(["importances"] if count > 1 else [])}
    for figure in drawn.values():
        figure.canvas.draw()
        paper = figure.bbox
        for axes in (axes for axes in figure.axes if axes.get_visible()):
            box = axes.get_tightbbox()
            assert paper.x0 <= box.x0 and box.x1 <= paper.x1 and paper.y0 <= box.y0
            ticks = [x.get_window_extent() for x in axes.get_xticklabels()]
            if not any(x.get_rotation() for x in axes.get_xticklabels()):
                assert not any(a.overlaps(b) for a, b in itertools.combinations(ticks, 2))
    names = [axes.get_xlabel() for axes in drawn["slices"].axes if axes.get_visible()]
    assert names == list(space)
    best = min(trials, key=lambda trial: trial.values[0])
    marked = drawn["slices"].axes[0].collections[1].get_offsets()
    assert marked[0][0] == pytest.approx(np.log10(best.params[RATE] / 1e-3))
    assert marked[0][1] == best.values[0]


@pytest.mark.parametrize("method", ["tpe", "random", "grid"])
def test_the_samplers_of_optuna(tmp_path, method):
    """A grid visits each point once; others begin with the base and resume with new points."""
    clips = {"choices": [0.1, 0.2, 0.3]} if method == "grid" else {"range": [0.1, 0.3]}
    space = {CLIP: clips, EPOCHS: {"range": [1, 2]}}
    search = {"method": method, "base_first": method != "grid"}
    sweep, directory, _ = open_small(tmp_path, space=space, search=search, budget={"trials": 6})
    for slot in (0, 1, 0):
        study = open_study(sweep, directory, slot)
        study.optimize(lambda trial: sum(sweep.suggest(trial).values()), n_trials=2)
    samplers = optuna.samplers
    kinds = {"tpe": samplers.TPESampler, "random": samplers.RandomSampler, "grid": Grid}
    assert isinstance(study.sampler, kinds[method])
    points = [tuple(trial.params.values()) for trial in study.trials]
    assert len(points) == 6 == len(set(points)) and trials_left(study, sweep) == 0
    assert method == "grid" or points[0] == (0.2, 1)
