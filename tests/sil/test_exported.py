"""Exported C on a simulated drone: its bits, its calls, and the files of the command."""

import contextlib
import ctypes
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
from quadjax.export.race_source import policy_race
from quadjax.export.verify import toolchain
from quadjax.export.verify.build import VEHICLE, Sources
from quadjax.flights import load
from quadjax.flights.flight import SIMULATED
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.sil import run as sil
from quadjax.sil.faults import RPM_PER_RAD_S
from quadjax.sil.run import Setting, fly_all, make_world
from quadjax.sil.source import ExportedC, at_rate
from quadjax.sil.worlds import MEASURED
from tests.commands import run
from tests.export.support import converted_in, made
from tests.sil.support import Autopilot, Counting, short_world


@pytest.mark.parametrize("crash", ["", "ground"])
@pytest.mark.parametrize(
    ("file", "step"), [("", "copy the C"), ("p.npz", "quadjax export 'an e2e'")]
)
def test_c_of_which_a_flight_crashed_is_not_to_be_used(file, step, crash, tmp_path, capsys):
    (tmp_path / "p.npz").touch()
    race = SimpleNamespace(flight=SimpleNamespace(time=[0.0], crash=""))
    laps = SimpleNamespace(crashes=(crash, ""))  # the last of two flights completes its laps
    flown = SimpleNamespace(setting=Setting(tmp_path / file, None), races=[race], laps=laps)
    assert command._shown(flown, tmp_path / "a #1", False, "an e2e") == 0
    printed = capsys.readouterr().out
    assert f"Next: quadjax view '{tmp_path / 'a #1' / 'states.npz'}'" in printed
    assert (f"Then: {step}" in printed) is not bool(crash)


def on_the_plant(folder):
    """A shipped policy on the plant ``standin``, with its own estimator."""
    policy = Policy.load(PRETRAINED / "e2e_residual_disturbance.npz")
    config, origin = race_of_policy(policy)
    race = policy_race(config, policy, origin)
    return converted_in(folder, policy, race, "cortex-a9", 512.0), load_plant_config("standin")


def in_the_simulator(folder):
    """A policy of the 5-inch drone in its simulator, through INDIflight's interface."""
    return converted_in(folder, *made("published racing"), "indiflight"), None


def random_states(count):
    """States of ``VEHICLE``, (1,) each."""
    rng, states = np.random.default_rng(3), np.zeros(count, VEHICLE)
    for name in MEASURED:
        states[name] = rng.uniform(-1, 1, states[name].shape)
    return np.split(states, count)


def sources_of(converted, folder):
    files = {name: data for name, data in converted.files().items() if "/" in name}
    return Sources.write(converted.target, files, folder / "c", converted.fixed)


def loaded(folder, converted, rate):
    """The C at the start of a race."""
    autopilot = ExportedC(converted, sources_of(converted, folder), rate)
    autopilot.begin()
    return autopilot


def flown_by_hand(converted, plant, folder, steps):
    """The motion and the commands (steps, ..) of the C called step by step."""
    plant = plant and at_rate(plant, sources_of(converted, folder))
    world = make_world(converted.race.config, converted.policy, plant, 1)
    autopilot = loaded(folder, converted, 1.0 / world.step)
    factor = RPM_PER_RAD_S if world.model.name == "motor" else 1.0
    now, rows = world.begin(0), []
    for number in range(steps):
        sent = autopilot.step(number * world.step, now.vehicle).astype(np.float64)
        wanted = np.float32(np.clip(sent * factor, *world.ranges()))
        rows.append(np.concatenate([now.true, wanted]))
        now = world.advance(now, wanted)
    return np.array(rows)


@pytest.fixture
def short_races(monkeypatch):
    monkeypatch.setattr(sil, "make_world", short_world)


@pytest.mark.slow
@pytest.mark.parametrize("make", [on_the_plant, in_the_simulator])
def test_a_race_has_the_bits_of_the_c_called_by_hand(make, tmp_path, monkeypatch, short_races):
    converted, plant = make(tmp_path)
    monkeypatch.setattr(sil, "read_folder", lambda *_: converted)
    flown = fly_all(Setting(tmp_path, plant, laps=1), threading.Event())
    race = flown.races[0]
    rows = np.concatenate([race.flight[name] for name in SIMULATED], axis=1)
    expected = flown_by_hand(converted, plant, tmp_path, len(rows))
    np.testing.assert_array_equal(rows, expected)
    assert set(race.counts) <= {"steps", "autopilot: clipped steps", "autopilot: outside steps"}
    assert set(race.counts) - {"steps"} < set(sil.MEANINGS)
    of_plant = make is on_the_plant
    assert ("its own estimator" in flown.autopilot) == of_plant and len(rows) > 20
    assert ("512 Hz" in flown.drone) == of_plant and "in the glue of" in flown.sources
    flown.write(tmp_path / "out")
    (flight,) = load(tmp_path / "out" / "states.npz")
    np.testing.assert_array_equal(flight["position"], race.flight["position"])
    assert flight.source["vehicle"] == converted.policy.vehicle and len(flight.gates) > 2
    numbers = json.loads((tmp_path / "out" / "sil.json").read_text())
    assert numbers["runs"] == 1 and numbers["counts"]["steps"] == len(rows)


@pytest.mark.slow
def test_a_shipped_policy_flies_with_one_command(tmp_path, monkeypatch, capsys, short_races):
    monkeypatch.chdir(tmp_path)
    assert run("sil", "indi", "--laps", 1) == 0
    printed, errors = capsys.readouterr()
    assert "\ndrone: plant cyberzoo, 512 Hz, " in printed
    assert len(printed.splitlines()) == 8 and re.search(r"drone: .*, [\d,]+ steps\n", printed)
    begun = [line.partition(":")[0] for line in errors.splitlines()]
    assert len(begun) == len(set(begun)) and begun[-1] == "wrote runs/sil/"
    assert "C that flies: indi.qjp, paparazzi/" in printed and "glue of Paparazzi" in printed
    assert printed.endswith("Next: quadjax view runs/sil/states.npz\n")  # it completes no lap
    assert run("view", "runs/sil/states.npz", "--output", "page.npz") == 0
    assert len(load(tmp_path / "page.npz")) == 1


def test_the_glue_is_called_at_its_own_rate_while_states_are_lost(tmp_path):
    converted = converted_in(tmp_path, *made("indi and more"), "cortex-a9")
    autopilot = loaded(tmp_path, converted, 500.0)
    steps = (ctypes.c_float * 15).in_dll(autopilot._library, "paparazzi_sent")
    (state,) = random_states(1)
    for number in (0, 1, 2, 3, 4, 5, 9, 10, 24, 25, 40):  # of 500 Hz; a step is five calls
        autopilot.step(number / 500.0, state)
        assert steps[6] == number // 5 + 1, number
    autopilot.begin()
    autopilot.step(0.2, state)  # the first states of a race are lost
    assert steps[6] == 40 // 5 + 2


@pytest.mark.slow
def test_a_policy_of_earlier_steps_keeps_its_steps_at_another_rate(tmp_path):
    converted = converted_in(tmp_path, *made("indi and more"), "cortex-m7")
    autopilot = loaded(tmp_path, converted, 500.0)  # a step is five calls, without a glue
    sent = np.array([autopilot.step(n / 500.0, state) for n, state in enumerate(random_states(40))])
    assert autopilot.files.startswith("made.qjp, c/{qj_check.c") and "glue" not in autopilot.files
    np.testing.assert_array_equal(sent, np.repeat(sent[::5], 5, axis=0))
    assert len(np.unique(sent, axis=0)) == 8


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rate", "words"),
    [
        ("indi and more", 130.0, "no whole number of calls is a step of it, within 3%"),
        ("battery", 100.0, "cannot fly here: .*the highest rpm is for another rate"),
    ],
)
def test_c_for_another_rate_is_refused(name, rate, words, tmp_path):
    converted = converted_in(tmp_path, *made(name), "cortex-m7", 512.0)
    with pytest.raises(InputError, match=words):
        loaded(tmp_path, converted, rate)


REFUSED = {  # commands of export, verify and sil
    ("export", "", "--output", "c"): "'', allowed: a policy file",
    ("export", "none.npz", "--output", "c"): "none.npz: no such file",
    ("export", "indi", "--output", "c", "--name", "_x"): "identifier",
    ("verify", ""): "'', allowed: the folder of quadjax export",
    ("verify", "none"): "none: no such folder, expected a folder of quadjax export",
    ("verify", "none.qjp"): "none.qjp: no such file",
    ("verify", "."): "expected one *_report.json",
    ("sil", ""): "'', allowed: the folder of quadjax export",
    ("sil", "none"): "none: neither a folder of quadjax export nor a policy, allowed also: e2e",
    ("sil", "exported/made.qjp"): "exported: expected one *_report.json",
    ("sil", "."): "expected one *_report.json",
}


def test_wrong_names_are_refused_before_jax_is_imported(tmp_path):
    (tmp_path / "exported").mkdir()
    for name, text in ((".quadjax.json", '{"kind": "export"}'), ("made.qjp", "")):
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
    converted = converted_in(tmp_path / "made", *made("published racing"), "cortex-m7")
    texts = []

    def interruptions(text):
        texts.append(text)
        return contextlib.nullcontext(stop)

    monkeypatch.setattr(command, "interruptions", interruptions)
    monkeypatch.setattr(sil, "convert_file", lambda *_, **options: converted)
    monkeypatch.setattr(sil, "make_world", lambda *_: Counting())
    monkeypatch.setattr(sil, "ExportedC", lambda *_: Autopilot())
    assert run("sil", "indi") == 130
    assert not (tmp_path / "runs").exists() and b"a flight that has begun is saved" in texts[0]


def test_a_machine_without_compiler_is_one_line(tmp_path, monkeypatch):
    converted, _ = in_the_simulator(tmp_path)
    sources = sources_of(converted, tmp_path)
    monkeypatch.setattr(toolchain.shutil, "which", lambda name: None)
    monkeypatch.setattr(toolchain, "has_module", lambda name: False)
    with pytest.raises(InputError, match="no C compiler on this machine"):
        ExportedC(converted, sources, 100.0)
