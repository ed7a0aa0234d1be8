"""Flight logs: a known model is fitted, laps are read from a log."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.commands import run

TRUTH = Path(__file__).resolve().parents[2] / "configs/vehicles/bebop1.yaml"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of a drone with the constants of ``TRUTH``."""
    folder = tmp_path_factory.mktemp("logs")
    words = ("--flights", 1, "--laps", 3, "--output", folder)
    assert run("logs", "exact", "--policy", "e2e_nominal", "--policy", "indi_shac", *words) == 0
    return folder


@pytest.mark.slow
def test_every_constant_of_a_known_model_is_within_2_percent(logs, tmp_path):
    words = (f"logs.files=[{logs}/*.csv]", "--output", tmp_path, "--name", "fit")
    short = ("residual.seeds=1", "residual.epochs=3")
    assert run("fit", "paparazzi", *words, *short) == 0
    truth = yaml.safe_load(TRUTH.read_text())["motor"]
    fitted = yaml.safe_load((tmp_path / "fit/vehicle.yaml").read_text())["motor"]
    numbers = {k: v for k, v in truth.items() if isinstance(v, (int, float)) and v}
    assert len(numbers) >= 15
    wrong = {
        key: (value, fitted[key])
        for key, value in numbers.items()
        if not math.isclose(value, fitted[key], rel_tol=0.02)
    }
    assert not wrong
    report = json.loads((tmp_path / "fit/report.json").read_text())
    assert report
    assert (tmp_path / "fit/residual.npz").exists()


@pytest.mark.slow
def test_a_log_of_the_plant_has_the_laps_that_were_flown(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ("--policy", "e2e_nominal", "--flights", 1, "--laps", 2, "--output", "logs")
    assert run("logs", "standin", *words) == 0
    words = ("--policy", "e2e_nominal", "--logs", "paparazzi", "--json", "replay.json")
    assert run("replay", "logs/e2e_nominal_0.csv", *words) == 0
    laps = json.loads(Path("replay.json").read_text())["lap_times"]
    np.testing.assert_allclose(laps, [2.8, 2.4], atol=0.3)
