"""Flight logs: a known model is fitted, faulty columns are rejected."""

import csv
import json
import math
from pathlib import Path

import pytest
import yaml

from tests.commands import run

TRUTH = Path(__file__).resolve().parents[2] / "configs/vehicles/bebop1.yaml"


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    """Two logs of a drone with the constants of ``TRUTH``."""
    folder = tmp_path_factory.mktemp("logs")
    words = ("--flights", 1, "--laps", 3, "--output", folder)
    assert run("logs", "exact", "--policy", "e2e", "--policy", "indi", *words) == 0
    return folder


@pytest.mark.slow
def test_every_constant_of_a_known_model_is_within_2_percent(logs, tmp_path):
    words = (f"logs.files=[{logs}/*.csv]", "--output", tmp_path, "--name", "fit")
    short = ("residual.epochs=3", "figures=false")
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


def read(path: Path) -> dict[str, list[str]]:
    """The columns of a log."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


def write(path: Path, columns: dict[str, list[str]]) -> None:
    """Columns as a log."""
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(zip(*columns.values(), strict=True))


def faults(columns: dict[str, list[str]]) -> dict[str, dict[str, list[str]]]:
    """Two kinds of faults; all kinds are in tests/fitting."""
    motors = [f"rpm_obs_{i}" for i in range(1, 5)]
    return {
        "negated": {"att_theta": [repr(-float(value)) for value in columns["att_theta"]]},
        "turned": {motors[i]: columns[motors[(i + 1) % 4]] for i in range(4)},
    }


@pytest.mark.slow
def test_a_fault_of_the_columns_is_refused(logs, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    columns = read(sorted(logs.glob("*.csv"))[0])
    accepted = []
    for name, changed in faults(columns).items():
        write(tmp_path / "faulty.csv", columns | changed)
        status = run("fit", "paparazzi", "logs.files=[faulty.csv]", "residual.fit=false")
        message = capfd.readouterr().err.strip().splitlines()[-1]
        if status != 2 or "faulty.csv" not in message:
            accepted.append(name)
    assert not accepted
