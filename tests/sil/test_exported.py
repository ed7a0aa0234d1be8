"""Exported C on a simulated drone: its bits, its calls, and the files of the command."""

import contextlib
import json
import re
import subprocess
import sys
import threading
from types import SimpleNamespace

import numpy as np
import pytest

from quadjax.cli import sil as command
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.export import compiler
from quadjax.flights import load
from quadjax.flights.flight import SIMULATED
from quadjax.plant.config import load_plant_config
from quadjax.sil import run as sil
from quadjax.sil.autopilot import ExportedC
from quadjax.sil.run import Setting, fly_all
from tests.commands import run
from tests.export.support import converted
from tests.sil.support import Autopilot, Counting, short_drone


@pytest.mark.parametrize("crash", ["", "ground"])
@pytest.mark.parametrize(
    ("file", "step"), [("", "quadjax export"), ("p.npz", "quadjax export 'an e2e'")]
)
def test_c_of_which_a_flight_crashed_is_not_to_be_used(file, step, crash, tmp_path, capsys):
    (tmp_path / "p.npz").touch()
    race = SimpleNamespace(flight=SimpleNamespace(time=[0.0], crash=""))
    laps = SimpleNamespace(crashes=(crash, ""))  # the last of two flights completes its laps
    flown = SimpleNamespace(setting=Setting(tmp_path / file, None), races=[race], laps=laps)
    assert command._shown(flown, tmp_path / "a #1", False, "an e2e") == 0
    printed = capsys.readouterr().out
    assert f"Next: quadjax view '{tmp_path / 'a #1' / 'states.npz'}'" in printed
    assert (f"Then: {step}" in printed) is (bool(file) and not crash)


SHIPPED = PRETRAINED / "e2e_residual_disturbance.npz"
PLANTS = {"plant": "standin", "simulator": None}


@pytest.fixture
def short_races(monkeypatch):
    monkeypatch.setattr(sil, "make_drone", short_drone)


def flown_by_hand(setting, folder, steps):
    """The motion and the commands (steps, ..) of the C called step by step."""
    of, setting = sil._converted(setting)
    drone = sil.make_drone(of.race.config, of.policy, setting.plant, 1)
    autopilot = ExportedC(of, folder, 1.0 / drone.step)
    autopilot.begin()
    now, held, rows = drone.begin(0), sil_resting(drone), []
    for number in range(steps):
        vehicle, now_us = now.vehicle.copy(), round(1e6 * number * drone.step)
        vehicle["time_us"] = vehicle["position_us"] = now_us
        vehicle["autopilot_command"] = held
        held = np.float32(np.clip(autopilot.step(now_us, vehicle)[1], *drone.ranges()))
        values = now.true | {"command": held}
        rows.append(np.concatenate([np.ravel(values[name]) for name in SIMULATED]))
        now = drone.advance(now, held)
    return np.array(rows)


def sil_resting(drone):
    return drone.begin(0).true["actuators"].astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("where", PLANTS)
def test_a_race_has_the_bits_of_the_c_called_by_hand(where, tmp_path, short_races):
    plant = PLANTS[where] and load_plant_config(PLANTS[where])
    setting = Setting(SHIPPED, plant, laps=1)
    flown = fly_all(setting, threading.Event())
    race = flown.races[0]
    rows = np.concatenate([race.flight[name] for name in SIMULATED], axis=1)
    np.testing.assert_array_equal(rows, flown_by_hand(setting, tmp_path / "c", len(rows)))
    assert set(race.counts) <= {"steps", "autopilot: outside steps"} and len(rows) > 20
    assert "its own estimators" in flown.autopilot
    assert ("100 Hz" in flown.drone) == (plant is None)
    assert len(flown.text().splitlines()) <= 7
    flown.write(tmp_path / "out")
    (flight,) = load(tmp_path / "out" / "states.npz")
    np.testing.assert_array_equal(flight["position"], race.flight["position"])
    assert flight.source["vehicle"] == "motor" and len(flight.gates) > 2
    numbers = json.loads((tmp_path / "out" / "sil.json").read_text())
    assert numbers["runs"] == 1 and numbers["counts"]["steps"] == len(rows)


@pytest.mark.slow
def test_a_shipped_policy_flies_with_one_command(tmp_path, monkeypatch, capsys, short_races):
    monkeypatch.chdir(tmp_path)
    assert run("sil", "indi", "--laps", 1, "--drop", 0.1, "--stuck", "rates=0.1") == 0
    printed, errors = capsys.readouterr()
    assert "; drone: plant cyberzoo, 512 Hz, " in printed
    assert len(printed.splitlines()) <= 8 and re.search(
        r"states: \d+ dropped, \d+ stuck; pilot: \d+ calls without", printed
    )
    begun = [line.partition(":")[0] for line in errors.splitlines()]
    assert len(begun) == len(set(begun)) and begun[-1] == "wrote runs/sil/"
    assert "flies: indi.h and qj_*.c of paparazzi/" in printed
    assert printed.endswith("Next: quadjax view runs/sil/states.npz\n")  # it completes no lap
    assert run("view", "runs/sil/states.npz", "--output", "page.npz") == 0
    assert len(load(tmp_path / "page.npz")) == 1


@pytest.mark.slow
def test_the_plant_runs_at_the_rate_of_an_exported_folder(tmp_path, monkeypatch):
    of = converted("battery", tmp_path, sample_rate=500.0)
    monkeypatch.setattr(sil, "read_folder", lambda *_: of)
    plant = load_plant_config("cyberzoo")
    _, setting = sil._converted(Setting(tmp_path, plant))
    assert setting.plant.control_rate == 500.0 != plant.control_rate
    with pytest.raises(
        InputError, match="100 calls a second .*another rate.*--sample-rate 100, or fly"
    ):
        ExportedC(of, tmp_path / "c", 100.0)


REFUSED = {  # commands of export, verify and sil
    ("export", "", "--output", "c"): "'', allowed: a policy file",
    ("export", "none.npz", "--output", "c"): "none.npz: no such file",
    ("export", "indi", "--output", "c", "--name", "_x"): "identifier",
    ("verify", ""): "'', allowed: the folder of quadjax export",
    ("verify", "none"): "none: no such folder, expected a folder of quadjax export",
    ("verify", "."): "expected one *_report.json",
    ("sil", ""): "'', allowed: the folder of quadjax export",
    ("sil", "none"): "none: neither a folder of quadjax export nor a policy, allowed also: e2e",
    ("sil", "exported"): "exported: expected one *_report.json",
    ("sil", "."): "expected one *_report.json",
}


def test_wrong_names_are_refused_before_jax_is_imported(tmp_path):
    (tmp_path / "exported").mkdir()
    for name, text in ((".quadjax.json", '{"kind": "export"}'), ("made.h", "")):
        (tmp_path / "exported" / name).write_text(text)
    code = (
        "import sys\nfrom quadjax.cli import run\n"
        f"statuses = [run(list(words)) for words in {list(REFUSED)}]\n"
        "print(set(statuses), 'jax' in sys.modules)"
    )
    program = [sys.executable, "-c", code]
    done = subprocess.run(program, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.strip() == "{2} False", done.stderr
    lines = done.stderr.strip().splitlines()
    assert [path.name for path in tmp_path.iterdir()] == ["exported"]
    assert all(text in line for text, line in zip(REFUSED.values(), lines, strict=True)), lines


def test_a_target_has_no_effect_with_the_folder_of_an_export(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    for name in ("x_report.json", "policy.npz", "config.yaml"):
        (tmp_path / name).touch()
    (tmp_path / ".quadjax.json").write_text('{"kind": "export"}')
    assert run("sil", ".", "--target", "indiflight") == 2
    assert "--target has no effect with the folder of an export" in capfd.readouterr().err


def test_ctrl_c_before_the_first_step_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    stop = threading.Event()
    stop.set()
    of = converted("published racing", tmp_path / "made")
    texts = []

    def interruptions(text):
        texts.append(text)
        return contextlib.nullcontext(stop)

    monkeypatch.setattr(command, "interruptions", interruptions)
    monkeypatch.setattr(sil, "convert_file", lambda *_, **options: of)
    monkeypatch.setattr(sil, "make_drone", lambda *_: Counting())
    monkeypatch.setattr(sil, "ExportedC", lambda *_: Autopilot())
    assert run("sil", "indi") == 130
    assert not (tmp_path / "runs").exists() and b"a flight that has begun is saved" in texts[0]


def test_a_machine_without_compiler_is_one_line(tmp_path, monkeypatch):
    of = converted("published racing", tmp_path)
    monkeypatch.setattr(compiler.shutil, "which", lambda name: None)
    monkeypatch.setattr(compiler, "has_module", lambda name: False)
    with pytest.raises(InputError, match="no C compiler on this machine"):
        ExportedC(of, tmp_path / "c", 100.0)
