"""The best known lap of the paper's track."""

import json

import numpy as np
import pytest

from tests.commands import run


@pytest.mark.slow
def test_the_best_known_lap_of_square4(tmp_path):
    files = ("--json", tmp_path / "lap.json", "--npz", tmp_path / "lap.npz")
    assert run("limit", "e2e +fastest", "--starts", 1, *files) == 0
    lap = json.loads((tmp_path / "lap.json").read_text())
    assert abs(lap["best_known"] - 2.0385) < 0.004
    with np.load(tmp_path / "lap.npz") as file:
        assert all(np.isfinite(file[key]).all() for key in file if file[key].dtype.kind == "f")
