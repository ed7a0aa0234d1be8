"""E2E against INDI: rows, the lead on common flights, drawn plants, and the command."""

import importlib
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.ablation import VARIANTS
from quadjax import compare
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError, InputWarning
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation import report
from quadjax.evaluation.rows import Row, concatenate
from quadjax.flights.flight import Flight, Signal
from quadjax.training.build import untrained_policy
from tests.commands import run
from tests.evaluation.support import flights

evaluation = importlib.import_module("quadjax.evaluation.evaluate")  # not the function
ROOT = Path(__file__).resolve().parents[2]


def laps(*seconds):
    """Flights of six laps of these times, s; NaN for one that crashes in its fourth lap."""
    return flights(*6.0 * np.array(seconds), laps=6, before=3)


def evaluated(flown, command, unit="rpm", name="command"):
    values = Signal(np.full((10, 4), command), unit)
    flight = Flight("", np.arange(10.0), {name: values, "command": values})
    return SimpleNamespace(row=Row("", flown), laps=flown, flights=[flight])


def test_the_table_has_flights_of_this_comparison_only():
    """INDI finishes a slow flight that E2E does not: without it the lead is 0.25 s a lap."""
    flown = {
        "E2E simulated": evaluated(laps(2.5, 2.5), 7000.0),
        "E2E stand-in plant": evaluated(laps(*[2.6] * 5, np.nan), 11000.0, name="motor_command"),
        "INDI simulated": evaluated(laps(2.75, 2.75), 7.0, ("rad/s",) * 4),
        "INDI stand-in plant": evaluated(laps(*[2.85] * 5, 4.0), 3000.0, name="motor_command"),
    }
    vehicle = load_config("e2e +residual").vehicle
    text = compare.table_text({"E2E": vehicle, "INDI": vehicle}, flown)
    ahead = "flights that both finish: +1.50 s; first lap +0.25 s, each later lap +0.25 s"
    for line in (
        "5/6",
        f"E2E's lead over INDI, simulated, on the 2 of 2 {ahead}",
        f"E2E's lead over INDI, stand-in plant, on the 5 of 6 {ahead}",
        "E2E's rpm commands at a limit: 0% simulated, 100% stand-in plant\n",
        "INDI's rpm commands at a limit: 100% stand-in plant",
        "E2E stand-in plant: run 6: hit a gate in lap 4",
    ):
        assert line in text, text
    assert "published" not in text
    shares = [compare.limit_fraction(vehicle, result) for result in flown.values()]
    assert shares == [0.0, 1.0, None, 1.0]
    none = Row("", laps(np.nan, 2.75))
    text = compare.lead("simulated", Row("", laps(2.5, np.nan)), none)
    assert text == "E2E's lead over INDI, simulated: no flight that both finish"


def on_plants(*plants):
    return [Row("", concatenate([laps(*each) for each in plants]), "all effects", len(plants))]


def test_the_table_of_plants_is_of_the_flights_that_both_finish():
    """E2E finishes the fast plant alone, INDI both: without INDI's slow plant it is slower."""
    e2e, indi = on_plants((2.4, 2.4), (np.nan, 2.5)), on_plants((2.9, 2.9), (3.0, 3.0))
    text, _ = compare.plants_table(e2e, indi)
    assert "14.70 ± 3.81" in text and "3/4" in text and "4/4" in text
    assert "E2E, all effects, early ends: hit a gate 1\n" in text
    assert "+3.00 ± 0.00 s; first lap +0.50 ± 0.00 s, each later lap +0.50 ± 0.00 s" in text
    e2e, indi = on_plants((2.5, np.nan), (np.nan, np.nan)), on_plants((2.4, 3.0), (3.0, 3.0))
    text, numbers = compare.plants_table(e2e, indi)
    assert "all effects 15.00 1/4 14.40 4/4" in " ".join(text.split())
    assert "all effects: both finish 1 of 4 flights, on 1 of 2 drones" in text
    assert "all effects, on the 1 of 4 flights that both finish: -0.60 s; first lap -0.10 s" in text
    found = numbers["INDI"]["all effects"]
    assert found["mean"] == pytest.approx(14.4) and found["each plant"][1] is None
    assert (found["both finish"], found["finished"], found["runs"]) == (1, 4, 4)


def test_contenders_fly_their_own_races_which_must_be_alike(tmp_path, capsys):
    """INDI of a thrust of up to 18 m/s^2: in its own race, and with its constants in another."""
    own = load_config("indi", ["vehicle.constants.thrust_max=18"])
    files = {"E2E": PRETRAINED / "e2e.npz", "INDI": tmp_path / "indi18.npz"}
    untrained_policy(own).save(files["INDI"])
    found = compare.contenders(files)["INDI"]
    assert found.race.vehicle.constants["thrust_max"] == 18.0
    with pytest.warns(InputWarning, match="thrust_max is 18 in training, 15 here"):
        named = compare.contenders(files, load_config("e2e"))["INDI"]
    assert found.drone.constants == named.drone.constants == own.vehicle.constants
    untrained_policy(load_config("indi", ["track=figure8"])).save(files["INDI"])
    assert run("compare", "standin", "--indi", files["INDI"], "--output", tmp_path) == 2
    error = capsys.readouterr().err
    assert "track is square4 in the race of" in error and "(--race CONFIG)" in error
    change = "vehicle.constants.thrust_max=18"
    assert run("compare", "standin", change, "--output", tmp_path) == 2
    assert "(overrides change the plant, not the race)" in capsys.readouterr().err


@pytest.mark.parametrize("part", ["plants", "table"])
def test_a_race_of_neither_is_told_once_of_each(part, tmp_path, capsys, monkeypatch):
    """The warnings are those of the contenders, although each flies several times."""

    def stop(*_, **__):
        raise InputError("stopped")

    monkeypatch.setattr(evaluation, {"plants": "fly_plants", "table": "simulate"}[part], stop)
    race = tmp_path / "race.yaml"
    race.write_text("base: e2e\nrules: {position_limit: 20}\n")
    where = ("--race", race, "--parts", part, "--output", tmp_path)
    assert run("compare", "standin", *where) == 2
    error = capsys.readouterr().err
    assert "error: stopped" in error and error.count("trained in another race") == 2


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: f"{v.group} {v.label}")
def test_policies_of_the_ablation_can_be_trained(variant, monkeypatch):
    monkeypatch.chdir(ROOT)
    config, *arguments = variant.training
    read = load_config(config, [f"name={variant.policy}", *arguments])
    assert read.name == variant.policy and read.vehicle.model == "motor"
    assert (PRETRAINED / "ablation" / f"{variant.policy}.npz").is_file()


@pytest.mark.slow
def test_the_command_flies_draws_and_writes(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(report, "FORMATS", ("png",))  # test_report.py writes every format
    options = ["--runs", 2, "--laps", 1, "--drones", 2, "--conditions", "all effects"]
    assert run("compare", "standin", *options, "--output", tmp_path) == 0
    text = capsys.readouterr().out
    assert "E2E simulated" in text and "2 drawn drones" in text
    written = json.loads((tmp_path / "compare" / "compare.json").read_text())
    assert written["INDI"]["stand-in plant"]["finished"] == 2
    assert written["plants"]["E2E"]["all effects"]["runs"] == 2
    names = {path.name for path in (tmp_path / "compare" / "report").iterdir()}
    assert {"gaps.png", "trajectories.png", "errors_4.png", "table.tex"} <= names
    assert len(written["rms error to the first-order response"]["INDI stand-in plant"]) == 3
