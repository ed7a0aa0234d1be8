"""What a sweep leaves: its table, importances, figures and the best config."""

import csv

import numpy as np
import pytest
from PIL import Image

from quadjax.config.loading import load_config
from quadjax.sweeps import locks, objective, progress, report
from quadjax.sweeps.schema import ObjectiveConfig
from quadjax.sweeps.store import Counts
from tests.sweeps.support import open_store

SPACE = {
    "ppo.clip": {"range": [0.1, 0.3]},
    "ppo.learning_rate": {"log": [1e-4, 1e-2]},
    "network.hidden": {"choices": [[8], [16, 16]]},
}


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    """Forty trials whose value is the clip's alone; one pruned, one failed."""
    opened = open_store(tmp_path_factory.mktemp("sweep"), space=SPACE, budget={"trials": 40})
    while (claim := opened.claim(locks.this_worker())) is not None:
        value = 10.0 + 20.0 * abs(claim.params["ppo.clip"] - 0.17)
        if claim.slot == 7:
            opened.fail(claim, "no such luck")
            continue
        opened.note(claim, "values", [value])
        opened.note(claim, "seconds", 1.5)
        opened.finish(claim, value, pruned=claim.slot == 3)
    return opened


def test_trials_are_told_best_first(store):
    results = report.results_of(store)
    assert len(results) == 40
    assert [r.state for r in results[-2:]] == ["pruned", "failed"]
    values = [r.value for r in results[:-2]]
    assert values == sorted(values) and results[-1].error == "no such luck"
    text = report.format_results(results[:3], list(SPACE))
    assert text.splitlines()[0].count("|") == text.splitlines()[2].count("|") == 9
    assert f"{values[0]:.3f}" in text and "clip" in text and "[" in text


def test_the_key_that_matters_is_the_most_important(store):
    found = report.importances(store, report.results_of(store))
    assert sum(found.values()) == pytest.approx(1.0)
    assert max(found, key=found.get) == "ppo.clip" and found["ppo.clip"] > 0.6


def test_everything_is_written(store):
    text = report.write_report(store)
    assert "best.yaml" in text and "importance" in text
    with open(store.directory / "trials.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 40 and float(rows[0]["ppo.clip"]) == pytest.approx(0.17, abs=0.02)
    config = load_config(store.directory / "best.yaml")
    assert config.ppo.clip == report.results_of(store)[0].params["ppo.clip"]
    assert config.train.devices == "auto"
    for name in ("parallel.png", "slices.png"):
        with Image.open(store.directory / name) as image:
            assert image.size[0] > 600 and len(set(image.convert("L").tobytes())) > 20


def test_too_few_trials_have_no_importance(tmp_path):
    opened = open_store(tmp_path)
    opened.finish(opened.claim(locks.this_worker()), 1.0)
    assert report.importances(opened, report.results_of(opened)) == {}
    assert "three complete trials" in report.write_report(opened)


def test_a_lap_that_is_not_flown_costs_the_penalty():
    nan = np.nan
    assert objective.lap_time(np.array([[2.0, 3.0]]), 8.0) == 5.0
    assert objective.lap_time(np.array([[2.0, 3.0], [2.0, nan]]), 8.0) == 7.5
    assert objective.lap_time(np.array([[nan, nan]]), 8.0) == 16.0
    assert objective.median([5.0, 16.0, 6.0]) == 6.0


def test_seconds_to_a_target_are_of_training_alone(tmp_path):
    text = "steps,steps_per_second,lap_total\n100,10,inf\n200,20,16\n300,10,15\n"
    (tmp_path / "metrics.csv").write_text(text)
    assert objective.seconds_to(tmp_path, 15.7) == pytest.approx(25.0)
    assert objective.seconds_to(tmp_path, 16.5) == pytest.approx(15.0)
    assert objective.seconds_to(tmp_path, 10.0) == pytest.approx(25.0 * 2.5)
    (tmp_path / "metrics.csv").write_text("steps,steps_per_second,lap_total\n100,10,inf\n")
    assert objective.seconds_to(tmp_path, 15.7) == pytest.approx(40.0)
    row = {"best_lap_total": float("inf")}
    assert objective.so_far(row, ObjectiveConfig(), 6) == 48.0


def test_the_time_left_is_told():
    assert "unknown" in progress.time_left(10.0, 0, 5)
    assert progress.time_left(10.0, 2, 4) == "about 20 s left"
    assert progress.time_left(600.0, 2, 4) == "about 20 min left"
    assert progress.time_left(36000.0, 2, 4) == "about 20.0 h left"
    assert "best 13.20 s" in progress.describe(Counts(3, 1, 2, 0, 13.2))
