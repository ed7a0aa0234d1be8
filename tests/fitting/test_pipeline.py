"""The command, and what a fit may do to flights that it has not seen."""

import json
import time
from dataclasses import replace

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.folders import claim
from quadjax.fitting import fit as fits
from quadjax.fitting.config import load_fit_config
from quadjax.fitting.fit import fit
from quadjax.fitting.flight_log import read_logs, write_log
from quadjax.fitting.report import text_table
from quadjax.vehicle.residual import read_residual
from quadjax.vehicle.vehicle_file import read_vehicle, write_vehicle
from tests.commands import run

from .conftest import REPOSITORY
from .flights import simulated, write_flights

CONFIG = REPOSITORY / "configs/fit/paparazzi.yaml"
MOMENTS = ("Mx", "My", "Mz")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Four flights; of the last one the residual has the opposite sign."""
    folder = tmp_path_factory.mktemp("fit")
    for seed in range(4):
        sign = -1.0 if seed == 3 else 1.0
        residual = (5, sign, (0.008 * sign, 0.008 * sign, 0.003 * sign))
        write_log(folder / f"flight_{seed}.csv", simulated(seed, residual))
    return folder


@pytest.fixture(scope="module")
def fitted(folder):
    """What the command fits, and the folder that it writes to."""
    place, found = folder / "runs/all", []
    with claim(place, "fit"):
        for name in ("report.txt", "held_out_old.png", "notes.txt"):
            (place / name).write_text("earlier")

    def kept(*arguments):
        found.append(fit(*arguments))
        return found[0]

    training = "residual={epochs: 40, batch_size: 128, mirror: false}"
    words = (f"logs.files=[{folder}/*.csv]", training)
    where = ("--output", folder / "runs", "--name", "all", "--overwrite")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fits, "fit", kept)
        assert run("fit", CONFIG, *words, *where) == 0
    return found[0], place


@pytest.mark.slow
def test_the_command_writes_report_vehicle_residual_and_figures(fitted):
    result, place = fitted
    text = (place / "report.txt").read_text()
    for word in ("model motor", "training (", "held out", "az", "Mz", "per fold"):
        assert word in text
    assert "increases no fold's error by more than 10%" in text
    report = json.loads((place / "report.json").read_text())
    assert list(report["held_out"]) == [f"flight_{i}" for i in range(4)]
    for part in result.held_out:
        change = report["held_out"][part.name]["az"]["change"]
        assert change == pytest.approx(part.change[2], abs=1e-3)
    assert (place / "errors.png").stat().st_size > 1000
    assert len(list(place.glob("held_out_*.png"))) == 4  # not those of the earlier fit
    assert (place / "notes.txt").read_text() == "earlier"
    read_residual(place / "residual.npz")
    vehicle = read_vehicle(str(place / "vehicle.yaml"))
    assert vehicle.motor.rpm_max == 11000.0 and abs(vehicle.motor.tau / 0.06 - 1.0) < 0.05
    assert vehicle.models["rate"] == read_vehicle("bebop1.yaml").models["rate"]
    assert load_fit_config(place / "config.yaml").name == "all"


@pytest.mark.slow
def test_no_flight_is_harmed_by_the_residual_or_has_influence_on_its_own_prediction(fitted):
    """What fits the other flights harms the last one, so the written residual is scaled down."""
    result, _ = fitted
    choices = result.fitted.residual.choices
    for choice in choices.values():
        assert min(choice.gains) >= -0.1 - 1e-9
    # The error of the unlike flight is reported as it is: the others do not show it.
    held_out = {part.name: part.change for part in result.held_out}
    assert (held_out["flight_3"][3:] > 0.2).all()
    for axis in MOMENTS:
        assert choices[axis].scale < 0.7
        assert result.without["flight_3"].residual.choices[axis].scale > 0.9


def copied(folder, to, count):
    """The folder ``to`` with the first flights."""
    for name in (f"flight_{seed}.csv" for seed in range(count)):
        (to / name).write_bytes((folder / name).read_bytes())
    return to


@pytest.mark.slow
def test_a_test_flight_has_no_influence_on_the_fit(folder, tmp_path):
    """Constants, residual and choices are those of a fit without the file."""
    training = "residual={epochs: 2, mirror: false}"
    tested, without = (
        fit(load_fit_config(CONFIG, [f"logs.files=[{place}/*.csv]", training, *more]), place)
        for place, more in (
            (folder, ["split.test_flights=[flight_3]"]),
            (copied(folder, tmp_path, 3), []),
        )
    )
    assert [part.name for part in tested.held_out][3:] == ["flight_3"]
    assert replace(tested.vehicle, path=without.vehicle.path) == without.vehicle
    choices, others = (result.fitted.residual.choices for result in (tested, without))
    for axis, choice in choices.items():
        np.testing.assert_allclose(choice.gains, others[axis].gains, rtol=1e-5, err_msg=axis)


@pytest.mark.slow
def test_the_choice_of_constants_for_a_held_out_flight_is_made_without_it(bebop, folder, tmp_path):
    """The third flight is of a drone with half the drag, which the fits to it and another show."""
    copied(folder, tmp_path, 2)
    write_log(tmp_path / "flight_2.csv", simulated(2, k_x=0.5))
    arguments = [f"logs.files=[{tmp_path}/*.csv]", "residual.fit=false"]
    result = fit(load_fit_config(CONFIG, arguments), folder)
    assert [part.name for part in result.held_out] == ["flight_0", "flight_1", "flight_2"]
    for part in result.held_out:  # of the nominal model, without networks
        assert not part.change.any() and (part.rmse(part.nominal) > 0.0).all()
    assert "ax" in result.kept and result.vehicle.motor.k_x == bebop.k_x
    without = result.without["flight_2"].constants
    assert without.k_x != bebop.k_x and without.k_x == pytest.approx(bebop.k_x, rel=0.05)


RACING = ("vehicle=5inch.yaml", "body.inertia=null", "body.rpm_range=null")
WITHOUT_EFFECT = (
    ("split.test_fraction=0.4",),
    ("nominal.axes=[az]", "nominal.fit=false"),
    ("residual.epochs=2", "residual.fit=false"),
    ("seed=1", "residual.fit=false"),
    ("residual.max_harm=0.2", *RACING),
    ("body.inertia=base", RACING[0], RACING[2]),
    ("split.folds=3", *RACING, "split.by=time"),
)


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """The folder of two flights without a residual."""
    return write_flights(tmp_path_factory.mktemp("two"), 2)[0].parent


@pytest.mark.parametrize("words", WITHOUT_EFFECT, ids=lambda words: words[0])
def test_keys_without_effect_are_refused(words, two):
    key = words[0].partition("=")[0]
    words = (f"logs.files=[{two}/*.csv]", *words[::-1])
    with pytest.raises(InputError, match=rf"^{key} is .*, which has no effect: .*; allowed: "):
        fit(load_fit_config(CONFIG, words), two)


def test_an_axis_that_is_not_fitted_and_worse_than_none_is_named(bebop, two, tmp_path):
    """The base vehicle has five times the pitch moment of the flights' drone."""
    other = read_vehicle("bebop1.yaml").with_constants("motor", bebop.replace(k_q=5.0 * bebop.k_q))
    write_vehicle(tmp_path / "base.yaml", other, "a base")
    words = [
        "residual.fit=false",
        "nominal.axes=[ax, ay, az, Mx, Mz]",
        f"vehicle={tmp_path}/base.yaml",
    ]
    words += [f"logs.files={two}/flight_0.csv", "split.folds=2"]
    lines = [line for line in fit(load_fit_config(CONFIG, words), two).warnings if "R^2" in line]
    assert len(lines) == 1 and lines[0].startswith("My: R^2 is -")


def test_logs_of_a_drone_that_turns_faster_than_the_vehicle_are_refused(two):
    words = (f"logs.files=[{two}/*.csv]", "body.rpm_range=[3000, 5000]")
    with pytest.raises(InputError, match="rpm, those of the vehicle are 3000 to 5000"):
        fit(load_fit_config(CONFIG, words), two)


SLOWER = ("logs.units.rpm=erpm", "logs.pole_pairs=2")  # of the speeds, which are in rpm


def test_speeds_that_are_too_slow_for_the_drone_are_refused(two):
    words = (f"logs.files=[{two}/*.csv]", "body.rpm_range=[4500, 11000]", *SLOWER)
    with pytest.raises(InputError, match=r"rpm on average.*body.rpm_range.*logs.pole_pairs 1\?$"):
        fit(load_fit_config(CONFIG, words), two)


@pytest.mark.parametrize("span", ["[2000, 11000]", "null"])
def test_a_thrust_unlike_that_of_the_base_vehicle_names_the_unit_of_the_speeds(span, two):
    """Also within the range of the motors' speeds, and where commands have the same unit."""
    words = [f"logs.files=[{two}/*.csv]", f"body.rpm_range={span}", "residual.fit=false"]
    for more, count in (((), 0), (SLOWER, 1)):
        found = fit(load_fit_config(CONFIG, [*words, *more]), two).warnings
        lines = [line for line in found if "logs.units.rpm" in line]
        assert len(lines) == count, lines
    assert lines[0].startswith("k_w is 4") and "that are 0.5 times the true ones" in lines[0]
    assert lines[0].endswith("is logs.units.rpm rpm or the rpm of 1 or logs.pole_pairs 1?")


def test_missing_logs_of_the_simulated_drone_say_how_they_are_made(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run("fit", "standin") == 2
    assert "simulate them: quadjax logs standin --policy" in capsys.readouterr().err


def test_progress_is_printed_without_a_terminal(two, tmp_path, monkeypatch, capsys):
    def stop(config, folder, report):
        read_logs(config.logs.replace(files=config.logs.files[:1]), folder, report)
        time.sleep(0.5)
        raise InputError("stopped")

    monkeypatch.setattr(fits, "fit", stop)
    monkeypatch.setattr("quadjax.cli.output.LINE_AFTER_S", 0.1)
    logs = f"logs.files={two}/flight_0.csv"
    assert run("fit", CONFIG, logs, "--output", tmp_path) == 2
    assert capsys.readouterr().err == "reading flight_0.csv\nerror: stopped\n"


def test_every_config_of_the_folder_is_sound():
    for path in sorted((REPOSITORY / "configs/fit").glob("*.yaml")):
        load_fit_config(path)


def test_a_table_has_no_colors_where_the_environment_forces_them(monkeypatch):
    monkeypatch.setenv("FORCE_COLOR", "1")  # as a Jupyter kernel does
    text = text_table("errors", ["axis", "RMSE"], [["az", "0.2"]])
    assert text == "errors\naxis  RMSE\naz     0.2"


@pytest.mark.slow
def test_flights_left_out_are_not_harmed(plain_flights, tmp_path):
    """A shorter training than the default's."""
    logs = f"logs.files=[{plain_flights[0].parent}/*.csv]"
    words = [logs, "residual.epochs=40"]
    config = load_fit_config(REPOSITORY / "configs/fit/racing_quad.yaml", words)
    change = np.array([part.change[2:] for part in fit(config, tmp_path).held_out])
    assert change[:, 0].mean() < -0.08
    assert change.max() < 0.05
