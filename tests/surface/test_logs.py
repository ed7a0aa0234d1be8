"""Flight logs: a known model is fitted, faulty columns are rejected."""

import csv
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.commands import run

TRUTH = Path(__file__).resolve().parents[2] / "configs/vehicles/bebop1.yaml"
VECTORS = {
    "position": ("pos_x", "pos_y", "pos_z"),
    "velocity": ("vel_x", "vel_y", "vel_z"),
    "attitude": ("att_phi", "att_theta", "att_psi"),
    "rates": ("rate_p", "rate_q", "rate_r"),
    "motors": ("rpm_obs_1", "rpm_obs_2", "rpm_obs_3", "rpm_obs_4"),
}


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


def scaled(values: list[str], factor: float) -> list[str]:
    """A column times a factor."""
    return [repr(factor * float(value)) for value in values]


def late(values: list[str], count: int) -> list[str]:
    """A column that lags by a number of rows."""
    return values[:1] * count + values[:-count]


def faults(columns: dict[str, list[str]], sample_rate: float) -> dict[str, dict[str, list[str]]]:
    """Changed columns by the name of the fault."""
    table = {}
    for group, names in VECTORS.items():
        for name in names:
            table[f"-{name}"] = {name: scaled(columns[name], -1.0)}
            table[f"{name} constant"] = {name: columns[name][:1] * len(columns[name])}
        for a, b in itertools.combinations(names, 2):
            table[f"{a} and {b} swapped"] = {a: columns[b], b: columns[a]}
        for seconds in (0.1, 0.3):
            count = round(seconds * sample_rate)
            table[f"{group} {seconds} s late"] = {n: late(columns[n], count) for n in names}
    for group in ("position", "velocity", "rates"):
        for factor in (0.5, 1.5):
            names = VECTORS[group]
            table[f"{group} x {factor}"] = {n: scaled(columns[n], factor) for n in names}
    for order in ((1, 0, 3, 2), (1, 2, 3, 0)):
        names = VECTORS["motors"]
        table[f"motors {order}"] = {
            names[i]: columns[names[source]] for i, source in enumerate(order)
        }
    return table


@pytest.mark.slow
def test_every_fault_of_the_columns_is_refused(logs, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    columns = read(sorted(logs.glob("*.csv"))[0])
    time = np.array(columns["time"], float)
    table = faults(columns, 1.0 / float(np.median(np.diff(time))))
    assert len(table) > 50
    accepted = []
    for name, changed in table.items():
        write(tmp_path / "faulty.csv", columns | changed)
        status = run("fit", "paparazzi", "logs.files=[faulty.csv]", "residual.fit=false")
        message = capfd.readouterr().err.strip().splitlines()[-1]
        if status != 2 or "faulty.csv" not in message:
            accepted.append(name)
    assert not accepted
