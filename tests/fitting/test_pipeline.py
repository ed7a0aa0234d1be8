import json

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.folders import claim
from quadjax.fitting import fit as fits
from quadjax.fitting.config import load_fit_config
from quadjax.fitting.fit import fit
from quadjax.fitting.flight_log import read_logs, write_log
from quadjax.vehicle.residual import read_residual
from quadjax.vehicle.vehicle_file import read_vehicle
from tests.commands import run

from .conftest import REPOSITORY
from .flights import simulated, write_flights

CONFIG = REPOSITORY / "configs/fit/paparazzi.yaml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit")
    write_flights(folder, 3, residual=(5, 1.0, (0.008, 0.008, 0.003)))
    return folder


@pytest.fixture(scope="module")
def fitted(folder):
    with claim(folder / "runs/all", "fit"):
        for name in ("report.txt", "held_out_old.png", "notes.txt"):
            (folder / "runs/all" / name).write_text("earlier")
    arguments = [
        f"logs.files=[{folder}/*.csv]",
        "residual={seeds: 2, epochs: 10}",
    ]
    place = ["--output", folder / "runs", "--name", "all", "--overwrite"]
    assert run("fit", CONFIG, *arguments, *place) == 0
    return folder / "runs/all"


@pytest.mark.slow
def test_the_command_writes_report_vehicle_residual_and_figures(fitted):
    text = (fitted / "report.txt").read_text()
    for word in ("model motor", "training (", "held out", "az", "Mz", "per fold"):
        assert word in text
    report = json.loads((fitted / "report.json").read_text())
    assert set(report["held_out"]) == {"flight_0", "flight_1", "flight_2"}
    for evaluation in report["held_out"].values():
        assert evaluation["az"]["change"] < -0.2
    assert (fitted / "errors.png").stat().st_size > 1000
    assert len(list(fitted.glob("held_out_*.png"))) == 3  # not those of the earlier fit
    assert (fitted / "notes.txt").read_text() == "earlier"
    read_residual(fitted / "residual.npz")
    vehicle = read_vehicle(str(fitted / "vehicle.yaml"))
    assert vehicle.motor.rpm_max == 11000.0 and abs(vehicle.motor.tau / 0.06 - 1.0) < 0.05
    assert vehicle.models["rate"] == read_vehicle("bebop1.yaml").models["rate"]
    assert load_fit_config(fitted / "config.yaml").name == "all"


def test_flights_are_held_out_of_the_nominal_model_without_networks_too(folder):
    arguments = [f"logs.files=[{folder}/*.csv]", "residual.fit=false"]
    result = fit(load_fit_config(CONFIG, arguments), folder)
    assert [part.name for part in result.held_out] == ["flight_0", "flight_1", "flight_2"]
    for part in result.held_out:
        assert not part.change.any()
        assert (part.rmse(part.nominal) > 0.0).all()


@pytest.mark.slow
def test_the_choice_of_constants_for_a_held_out_flight_is_made_without_it(bebop, folder, tmp_path):
    """The third flight is of a drone with half the drag, which the fits to it and another show."""
    for name in ("flight_0", "flight_1"):
        (tmp_path / f"{name}.csv").write_bytes((folder / f"{name}.csv").read_bytes())
    write_log(tmp_path / "flight_2.csv", simulated(2, k_x=0.5))
    arguments = [f"logs.files=[{tmp_path}/*.csv]", "residual.fit=false"]
    result = fit(load_fit_config(CONFIG, arguments), folder)
    assert "ax" in result.kept and result.vehicle.motor.k_x == bebop.k_x
    without = result.constants[frozenset({2})]
    assert without.k_x != bebop.k_x and without.k_x == pytest.approx(bebop.k_x, rel=0.05)


def test_missing_logs_of_the_simulated_drone_say_how_they_are_made(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("fit", "standin") == 2
    assert "no such file (logs.files); simulate them: quadjax logs standin --policy" in (
        capsys.readouterr().err
    )


def test_progress_is_printed_without_a_terminal(folder, tmp_path, monkeypatch, capsys):
    def stop(config, folder, report):
        read_logs(config.logs.replace(files=config.logs.files[:1]), folder, report)
        raise InputError("stopped")

    monkeypatch.setattr(fits, "fit", stop)
    logs = f"logs.files={folder}/flight_0.csv"
    assert run("fit", CONFIG, logs, "--output", tmp_path) == 2
    assert capsys.readouterr().err == "reading flight_0.csv\nerror: stopped\n"


def test_every_config_of_the_folder_is_sound():
    for path in sorted((REPOSITORY / "configs/fit").glob("*.yaml")):
        load_fit_config(path)


@pytest.mark.slow
def test_flights_left_out_are_not_harmed(plain_flights, tmp_path):
    """A shorter training than the default's."""
    arguments = [
        f"logs.files=[{plain_flights[0].parent}/*.csv]",
        "residual={seeds: 2, epochs: 15}",
    ]
    config = load_fit_config(REPOSITORY / "configs/fit/racing_quad.yaml", arguments)
    change = np.array([part.change[2:] for part in fit(config, tmp_path).held_out])
    print(change)
    assert change[:, 0].mean() < -0.08
    assert change.max() < 0.05
