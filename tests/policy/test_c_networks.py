"""The C that the authors of the paper publish: tests run where it is in ``../shared``."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from quadjax.evaluation import published as table_1
from quadjax.vehicle.residual import digest, read_residual
from tests.commands import run

ROOT = Path(__file__).resolve().parents[2]
AUTHORS = ROOT.parent / "shared" / "authors"
PAGE = ROOT / "docs" / "guide" / "other_trainers.md"
E2E = [AUTHORS / "e2e" / name for name in ("neural_network.c", "nn_controller.c")]
INDI = [AUTHORS / "indi" / name for name in ("neural_network.c", "nn_controller.c")]
RESIDUAL = [AUTHORS / "residual" / name for name in ("nn_thrust.c", "nn_moment.c")]
pytestmark = pytest.mark.skipif(not AUTHORS.is_dir(), reason="no files of the authors")


def test_the_guide_has_the_digests_of_the_authors_files():
    page = PAGE.read_text()
    for path in (*E2E, *INDI, *RESIDUAL):
        assert hashlib.sha256(path.read_bytes()).hexdigest() in page, path


@pytest.mark.slow
@pytest.mark.parametrize(
    ("files", "trained", "row"),
    [
        ([*E2E, *RESIDUAL, "--thrust-sign", 1], "e2e_paper +authors_code", table_1.E2E),
        (INDI, "indi_table1", table_1.INDI),
    ],
    ids=["E2E", "INDI"],
)
def test_the_authors_policies_fly_the_times_of_table_1(tmp_path, capsys, files, trained, row):
    """The two commands of the guide."""
    out, laps = tmp_path / "policy.npz", tmp_path / "laps.json"
    assert run("import", trained, *files, "--output", out) == 0
    race = ["indi_table1"]
    if files is not INDI:
        assert digest(read_residual(out)) == table_1.RESIDUAL
        race = ["e2e_table1", f"vehicle.residual={out}"]
    assert run("evaluate", *race, "--policy", out, "--runs", 20, "--json", laps) == 0
    result = json.loads(laps.read_text())
    assert result["finished"] == result["runs"] == 20 and not result["deterministic"]
    assert np.mean(result["totals"]) == pytest.approx(row.total, abs=0.1)
    assert row.policy in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("files", "trained", "model"),
    [
        (
            [*E2E, *RESIDUAL, "--thrust-sign", 1, "--residual-range", 3000, 12000],
            "e2e_paper +authors_code",
            "motor",
        ),
        (INDI, "indi_table1", "rate"),
    ],
    ids=["E2E", "INDI"],
)
def test_on_cyberzoo_the_authors_policies_fly_as_on_the_real_drone(
    tmp_path, capsys, files, trained, model
):
    """Total, first lap and what finishes of 40 flights on 20 drones."""
    out, laps = tmp_path / "policy.npz", tmp_path / "laps.json"
    assert run("import", *trained.split(), *files, "--output", out) == 0
    race = ["e2e_table1", f"vehicle.residual={out}"] if model == "motor" else ["indi_table1"]
    on_plant = ("--plant", "cyberzoo", "--drones", 20, "--runs", 40, "--seed", 77)
    assert run("evaluate", *race, "--policy", out, *on_plant, "--json", laps) == 0
    result, real = json.loads(laps.read_text()), table_1.FLOWN[model]
    assert result["finished"] >= 34 and result["runs"] == 40
    finished = np.array([each for each in result["laps"] if None not in each], float)
    assert finished.sum(axis=1).mean() == pytest.approx(real.total, abs=0.3)
    assert finished[:, 0].mean() == pytest.approx(real.lap_means[0], abs=0.1)
    assert real.policy in capsys.readouterr().out
