"""A real trial: training, resuming, evaluation, and the command with its report."""

import csv
from threading import Event
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from quadjax.config.loading import load_config
from quadjax.race.laps import Laps
from quadjax.sweeps.report import write_report
from quadjax.sweeps.run import TrialFailed, objective, train_and_fly
from quadjax.sweeps.study import State
from tests.commands import run
from tests.sweeps.stand_in import CLIP, RATE, complete, finish, open_small, sweep_file


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

    monkeypatch.setattr("quadjax.evaluation.evaluate.evaluate", fly)
    plant = {"seeds": 1, "runs": 6, "plant": "standin", "plants": 2}
    sweep, directory, _ = open_small(tmp_path, objective=plant)
    params = {CLIP: 0.2, RATE: 1e-3}
    value = train_and_fly(sweep, params, 0, 0, directory / "seed0", lambda fraction, value: False)
    assert flown == [(6, 2, "standin", "motor")]
    assert value == (6.5, 0.5)  # 5 s, and the limit of 8 s


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
    assert "2/2 trials, no flight finished yet" in capfd.readouterr().out
    assert run(*arguments[:2], "--overwrite", "--report", *arguments[4:]) == 0
    assert (folder / "notes.txt").exists()


def test_the_report_has_a_table_figures_and_the_best_config(tmp_path):
    """Of thirty trials; one failed, one is without a finished flight."""
    space = {
        CLIP: {"range": [0.1, 0.3]},
        RATE: {"log": [1e-4, 1e-2]},
        "network.hidden": {"choices": [[8], [16, 16]]},
    }
    sweep, directory, study = open_small(tmp_path, space=space, budget={"trials": 30})
    for index in range(30):
        if index == 7:
            failed = study.ask()
            failed.set_user_attr("error", "not enough memory")
            study.tell(failed, state=State.FAIL)
        else:
            finish(study, sweep, *((48.0, 0.0) if index == 3 else ()))
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


def test_a_lap_that_is_not_flown_counts_its_share_of_the_time_limit():
    def value(lap_times, limit):
        return Laps(np.array(lap_times), ("",), np.zeros(1), limit).penalized

    nan = np.nan
    assert value([[2.0, 3.0]], 16.0) == 5.0
    assert value([[2.0, 3.0], [2.0, nan]], 16.0) == 7.5
    assert value([[nan, nan]], 40.0) == 40.0
