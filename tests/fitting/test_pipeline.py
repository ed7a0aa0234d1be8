import json
import subprocess
import sys

import numpy as np
import pytest

from quadjax.config.loading import load_config, read_yaml
from quadjax.core.errors import InputError
from quadjax.fitting.pipeline import load_fit_config
from quadjax.fitting.synthetic import make_residual
from quadjax.fitting.synthetic_log import simulate_flight, write_log
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual_file import read_residual

from .conftest import REPOSITORY

CONFIG = REPOSITORY / "configs/fit/paparazzi.yaml"


def _fit(*words):
    command = [sys.executable, str(REPOSITORY / "scripts/fit.py"), *map(str, words)]
    return subprocess.run(
        command, cwd=REPOSITORY, env=_environment(), capture_output=True, text=True, check=False
    )


def _environment():
    import os

    return os.environ | {"PYTHONPATH": str(REPOSITORY)}


@pytest.fixture(scope="module")
def folder(bebop, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit")
    vehicle = VehicleParams(bebop, make_residual(5, 1.0, (0.008, 0.008, 0.003)))
    for seed in range(3):
        columns = simulate_flight(vehicle, seed, seconds=20.0)
        write_log(folder / f"flight_{seed}.csv", columns)
    return folder


@pytest.mark.slow
def test_the_command_does_all_of_it(folder):
    done = _fit(
        CONFIG,
        f"logs.files=[{folder}/*.csv]",
        f"runs={folder}/runs",
        "name=all",
        "residual={seeds: 2, epochs: 10, teach_epochs: 20, batch: 256}",
    )
    assert done.returncode == 0, done.stderr
    for word in ("nominal model", "training:", "held out:", "az", "Mz", "per fold"):
        assert word in done.stdout
    results = folder / "runs/all"
    report = json.loads((results / "report.json").read_text())
    assert set(report["held_out"]) == {"flight_0", "flight_1", "flight_2"}
    for judged in report["held_out"].values():
        assert judged["az"]["change"] < -0.2
    assert (results / "errors.png").stat().st_size > 1000
    assert len(list(results.glob("held_out_*.png"))) == 3
    read_residual(results / "residual.npz")
    # The training command takes the vehicle file as it is.
    config = load_config(
        REPOSITORY / "configs/e2e.yaml",
        [f"vehicle.file={results}/vehicle.yaml", f"vehicle.residual={results}/residual.npz"],
    )
    assert config.vehicle.constants["rpm_max"] == 11000.0
    assert abs(config.vehicle.constants["tau"] / 0.06 - 1.0) < 0.05
    assert read_yaml(results / "config.yaml")["name"] == "all"


def test_flights_are_held_out_of_the_nominal_model_without_networks_too(folder):
    from quadjax.fitting.pipeline import changes, run_fit

    words = [f"logs.files=[{folder}/*.csv]", "residual.fit=false"]
    result = run_fit(load_fit_config(CONFIG, words), folder)
    assert [judged.name for judged in result.held_out] == ["flight_0", "flight_1", "flight_2"]
    for judged in result.held_out:
        assert not changes(judged).any()
        assert (judged.rmse(judged.nominal) > 0.0).all()


@pytest.mark.parametrize(
    "words",
    [
        ["logs.files=[nowhere/*.csv]"],
        ["residual.hiden=3"],
        ["residual.seeds=0"],
        ["residual.seeds=many"],
        ["split.by=rows"],
        ["vehicle=nowhere.yaml"],
        ["body.inertia=[1, 2]"],
        ["body.rpm_range=[5000, 3000]"],
        ["prepare.cutoff=400"],
        ["logs.min_seconds=100"],
        ["name=a/b"],
        ["nonsense"],
    ],
)
def test_bad_words_are_one_line(folder, words):
    from pathlib import Path

    from quadjax.fitting.pipeline import run_fit

    words = words if words[0].startswith("logs.files") else [f"logs.files=[{folder}/*.csv]", *words]
    with pytest.raises(InputError) as caught:
        run_fit(load_fit_config(CONFIG, words), Path(CONFIG).parent)
    assert "\n" not in str(caught.value)


def test_bad_input_ends_the_command_with_status_2_and_one_line(folder):
    done = _fit(CONFIG, "logs.files=[nowhere.csv]")
    assert done.returncode == 2 and done.stdout == ""
    assert done.stderr.startswith("error: nowhere.csv") and done.stderr.count("\n") == 1
    assert _fit("--help").returncode == 0


def test_every_config_of_the_folder_is_sound():
    for path in sorted((REPOSITORY / "configs/fit").glob("*.yaml")):
        load_fit_config(path)


@pytest.mark.slow
def test_real_flights_left_out_are_not_harmed(real_flights, tmp_path):
    """A shorter training than the default's: the harm is prevented by then."""
    words = [
        f"logs.files=[{real_flights[0].parent}/*.csv]",
        "residual={seeds: 3, epochs: 15, teach_epochs: 40}",
    ]
    config = load_fit_config(REPOSITORY / "configs/fit/racing_quad.yaml", words)
    from quadjax.fitting.pipeline import changes, run_fit

    result = run_fit(config, tmp_path)
    change = np.array([changes(judged)[2:] for judged in result.held_out])
    print(change)
    assert change[:, 0].mean() < -0.08
    assert change.max() < 0.05
