"""A real trial: training, resuming, evaluation, and the command with its report."""

import csv
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.race.laps import Laps
from quadjax.sweeps.report import importances, results_of, rows_of, write_report
from quadjax.sweeps.run import TrialFailed, objective, train_and_fly
from quadjax.sweeps.study import State
from tests.commands import run
from tests.sweeps.support import CLIP, RATE, finish, open_small, sweep_file


@pytest.mark.slow
def test_a_trial_resumes_its_training_and_reports_to_the_pruner(tmp_path):
    search = {"method": "random", "pruner": "median"}
    sweep, directory, study = open_small(tmp_path, search=search, objective={"seeds": 2, "runs": 2})
    stops = []

    def measure(sweep, params, index, seed, folder, enough):
        def stop_once(fraction, value):
            stops.append(fraction)
            return enough(fraction, value) or len(stops) == 2

        return train_and_fly(sweep, params, index, seed, folder, stop_once)

    trial = study.ask()
    with pytest.raises(TrialFailed):
        objective(trial, sweep, directory, measure, Event())
    assert trial.user_attrs["values"] == [] and stops == [0.25, 0.5]
    value = objective(trial, sweep, directory, measure, Event())
    assert value == 8.0  # the time limit of the one lap
    assert trial.user_attrs["values"] == [8.0, 8.0] and trial.user_attrs["finished"] == 0.0
    assert stops[2:] == [0.75, 1.0, 0.25, 0.5, 0.75, 1.0]
    assert [*study.trials[0].intermediate_values] == [2, 5, 7, 10, 12, 15, 17, 20]


@pytest.mark.slow
def test_a_trial_is_judged_on_drawn_plants(tmp_path, monkeypatch):
    flown = []

    def fly(policy, race, *, plant, plants, runs, **_):
        flown.append((runs, plants, plant, race.vehicle.model))
        times = np.array([[5.0], [np.nan]] * 3)
        ends = ("", "hit a gate") * 3
        laps = Laps(times, ends, np.array([5.0, 1.0] * 3), 8.0)
        return SimpleNamespace(laps=laps, finished=laps.finished)

    monkeypatch.setattr("quadjax.evaluation.evaluation.evaluate", fly)
    plant = {"seeds": 1, "runs": 6, "plant": "standin", "plants": 2}
    sweep, directory, _ = open_small(tmp_path, objective=plant)
    params = {CLIP: 0.2, RATE: 1e-3}
    value = train_and_fly(sweep, params, 0, 0, directory / "seed0", lambda fraction, value: False)
    assert flown == [(6, 2, "standin", "motor")]
    assert value == (6.5, 0.5)  # 5 s, and the limit of 8 s


def test_a_plant_that_is_not_there_is_found_before_any_training(tmp_path):
    with pytest.raises(InputError, match="stanndin"):
        open_small(tmp_path, objective={"seeds": 1, "runs": 4, "plant": "stanndin"})


@pytest.mark.slow
def test_a_whole_sweep_by_its_command(tmp_path, capfd):
    path = sweep_file(tmp_path, budget={"trials": 2}, search={"method": "tpe"})
    arguments = ["sweep", path, "--workers", 1, "--output", tmp_path / "runs"]
    assert run(*arguments) == 0
    printed = capfd.readouterr()
    assert "2/2 trials, no flight finished yet" in printed.err
    assert "No policy finished a flight" in printed.out and "best" not in printed.out
    folder = tmp_path / "runs" / "small"
    own = load_config(folder / "trials/0001/seed0/config.yaml")
    assert own.run.devices == 1 and own.learner.num_envs == 16
    assert "No policy" in (folder / "report.md").read_text()
    assert not (folder / "best.yaml").exists()
    (folder / "notes.txt").write_text("mine")
    assert run(*arguments) == 0 and run(*arguments, "--report") == 0
    assert "2 trials done, 0 to do" in capfd.readouterr().out
    assert run(*arguments[:2], "--overwrite", "--report", *arguments[4:]) == 0
    assert (folder / "notes.txt").exists()


SPACE = {
    CLIP: {"range": [0.1, 0.3]},
    RATE: {"log": [1e-4, 1e-2]},
    "network.hidden": {"choices": [[8], [16, 16]]},
}


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Thirty trials whose value is the clip's alone; one failed, one without a finished flight."""
    folder = tmp_path_factory.mktemp("sweep")
    sweep, directory, study = open_small(folder, space=SPACE, budget={"trials": 30})
    for index in range(30):
        if index == 7:
            failed = study.ask()
            failed.set_user_attr("error", "not enough memory")
            study.tell(failed, state=State.FAIL)
        elif index == 3:
            finish(study, sweep, 48.0, flown=0.0)
        else:
            finish(study, sweep)
    return sweep, directory, study


def test_the_report_has_a_table_importances_figures_and_the_best_config(found):
    sweep, directory, study = found
    results = results_of(study)
    values = [t.value for t in results[:-1]]
    assert len(results) == 30 and values == sorted(values) and values[-1] == 48.0
    assert results[-1].user_attrs["error"] == "not enough memory"
    rows = rows_of(results, [*sweep.space])
    assert all(len(row) == len(rows[0]) for row in rows) and "[16, 16]" in str(rows)
    text = write_report(study, sweep, directory)
    assert "best.yaml" in text and "| importance |" in text and f"{values[0]:.3f}" in text
    with open(directory / "trials.csv", newline="") as stream:
        table = list(csv.DictReader(stream))
    assert len(table) == 30 and float(table[0]["median"]) == pytest.approx(values[0], abs=1e-3)
    config = load_config(directory / "best.yaml")
    assert config.learner.clip_range == results[0].params[CLIP] and config.name == "small_best"
    assert config.run.devices == "auto"
    for name in ("parallel.png", "slices.png"):
        with Image.open(directory / name) as image:
            assert image.size[0] > 600 and len(set(image.convert("L").tobytes())) > 20


def test_the_key_that_matters_is_the_most_important(tmp_path):
    _, _, study = open_small(tmp_path)
    assert importances(study) == {}
    sweep, _, study = open_small(tmp_path / "clip", budget={"trials": 30})
    for _ in range(30):
        taken = study.ask()
        params = {key: sweep.suggest(taken, key) for key in sweep.space}
        study.tell(taken, abs(params[CLIP] - 0.17))
    shares = importances(study)
    assert sum(shares.values()) == pytest.approx(1.0) and shares[CLIP] > 0.6


def test_a_lap_that_is_not_flown_counts_its_share_of_the_time_limit():
    def value(lap_times, limit):
        return Laps(np.array(lap_times), ("",), np.zeros(1), limit).penalized

    nan = np.nan
    assert value([[2.0, 3.0]], 16.0) == 5.0
    assert value([[2.0, 3.0], [2.0, nan]], 16.0) == 7.5
    assert value([[nan, nan]], 40.0) == 40.0
