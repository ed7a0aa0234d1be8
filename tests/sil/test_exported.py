"""Exported C as a process: the bits of the same C in this process, and the command's files."""

import ctypes
import dataclasses
import json
import threading

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.export.conversion import Options
from quadjax.export.race_source import own_race
from quadjax.export.verify import toolchain
from quadjax.export.verify.folder import Inputs
from quadjax.flights import load
from quadjax.flights.flight import SIMULATED
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.sil import run as sil
from quadjax.sil.fly import FLOATS
from quadjax.sil.message import RPM_PER_RAD_S, Kind, new
from quadjax.sil.plant_world import PlantWorld
from quadjax.sil.run import Setting, fly_all, make_world
from quadjax.sil.source import label_of, write_sources
from tests.commands import run
from tests.export.test_layouts import converted_in, made
from tests.export.test_pilot import without_rotors
from tests.sil.support import Counting

PLANT = load_plant_config("standin")
STEPS = 150


def written(folder, policy, own, config, target, rate=500.0):
    """The C of a policy in a folder, without the simulated flights of an export."""
    options = converted_in(folder, policy, own, target, rate).options
    path = folder / "policy.npz"
    return Inputs(options, policy, config, own, path.name, "")


def trained(folder):
    """A shipped policy on the stand-in plant, with its own estimator."""
    policy = Policy.load(PRETRAINED / "e2e_adaptive.npz")
    config, origin = race_of_policy(policy)
    return written(folder, policy, own_race(config, policy, origin), config, "cortex-a9"), PLANT


def untrained(folder):
    """A policy of the 5-inch drone in its simulator, through INDIflight's interface."""
    policy, own = made("published racing")
    config, _ = race_of_policy(policy)
    return written(folder, policy, own, config, "indiflight"), None


def flown_in_this_process(inputs, plant, folder, steps):
    """The motion and the commands (steps, ..) of the C called through ctypes, step by step."""
    world = make_world(inputs.config, inputs.policy, plant, 1)
    sources = write_sources(folder, inputs, 1.0 / world.step, folder)
    library = ctypes.CDLL(str(sources.build(folder, shared=True)))
    assert library.sil_load() == 0
    library.sil_begin()
    factor = RPM_PER_RAD_S if world.model.name == "motor" else 1.0
    now, rows = world.begin(0), []
    for number in range(steps):
        state, command = new(Kind.STATE, time_s=number * world.step), new(Kind.COMMAND)
        values = np.split(now.numbers, np.cumsum([state[name].size for name in FLOATS])[:-1])
        for name, value in zip(FLOATS, values, strict=True):
            state[name] = value.reshape(state[name].shape)
        library.sil_step(*(x.ctypes.data_as(ctypes.c_void_p) for x in (state, command)))
        wanted = np.clip(command["command"].astype(np.float64) * factor, *world.ranges())
        rows.append(np.concatenate([now.true, np.float32(wanted)]))
        now = world.advance(now, np.float32(wanted))
    return np.array(rows), sources


def short(world):
    """The same world with a time limit of a few steps."""
    if isinstance(world, PlantWorld):
        return dataclasses.replace(world, plan=dataclasses.replace(world.plan, limit=STEPS))
    return world


@pytest.mark.slow
@pytest.mark.parametrize("make", [trained, untrained])
def test_lock_step_has_the_bits_of_the_same_c_in_this_process(make, tmp_path, monkeypatch):
    inputs, plant = make(tmp_path)
    monkeypatch.setattr(sil, "read_inputs", lambda *_: inputs)
    monkeypatch.setattr(sil, "make_world", lambda *arguments: short(make_world(*arguments)))
    setting = Setting(tmp_path, plant, laps=1)
    flown = fly_all(setting, threading.Event())
    race = flown.races[0]
    rows = np.concatenate([race.flight[name] for name in SIMULATED], axis=1)
    expected, sources = flown_in_this_process(inputs, plant, tmp_path, len(rows))
    np.testing.assert_array_equal(rows, expected)
    assert set(race.counts) <= {"steps", "autopilot: clipped steps", "autopilot: outside steps"}
    assert ("its own estimator" in flown.autopilot) == (make is trained) and len(rows) > 20
    flown.write(tmp_path / "out")
    (flight,) = load(tmp_path / "out" / "states.npz")
    np.testing.assert_array_equal(flight["position"], race.flight["position"])
    assert flight.source["vehicle"] == inputs.policy.vehicle and len(flight.gates) > 2
    numbers = json.loads((tmp_path / "out" / "sil.json").read_text())
    assert numbers["runs"] == 1 and numbers["counts"]["steps"] == len(rows)
    page = tmp_path / "page.npz"
    assert run("view", tmp_path / "out" / "states.npz", "--output", page) == 0
    assert len(load(page)) == 1


def in_this_process(folder, target, policy, own, rate=None):
    """The C of a target behind the messages as a library, and its sources."""
    config, _ = race_of_policy(policy)
    inputs = written(folder, policy, own, config, target)
    sources = write_sources(folder, inputs, rate or 1.0 / own.time_step, folder)
    return ctypes.CDLL(str(sources.build(folder, shared=True))), sources


def commands_of(library, states, step=0.01):
    """Commands (n, 4) of states that follow each other in a race."""
    assert library.sil_load() == 0
    library.sil_begin()
    rows = []
    for number, values in enumerate(states):
        state, command = new(Kind.STATE, time_s=step * number), new(Kind.COMMAND)
        for name, value in values.items():
            state[name] = value
        library.sil_step(*(x.ctypes.data_as(ctypes.c_void_p) for x in (state, command)))
        rows.append(command["command"].copy())
    return np.array(rows)


OTHERS = [("qjp", "indi and more"), ("qjp", "published racing"), ("crazyflie", "without rotors")]


@pytest.mark.parametrize(
    ("target", "race"),
    [("px4", "published racing"), *(pytest.param(*x, marks=pytest.mark.slow) for x in OTHERS)],
)
def test_every_target_flies_the_same_runtime(target, race, tmp_path):
    policy, own = without_rotors() if race == "without rotors" else made(race)
    library, sources = in_this_process(tmp_path / target, target, policy, own)
    names = {path.name for path in sources.files}
    assert {"qj_pilot.c", "qj_load.c"} <= names and not any("made" in name for name in names)
    assert "made.qjp" in sources.text and ("without" in sources.text) == (target != "qjp")
    plain, others = in_this_process(tmp_path / "c", "cortex-m7", policy, own)
    assert others.text.startswith("made.qjp, c/{qj_check.c")
    rng = np.random.default_rng(3)
    fields = {"position_ned_m": 3, "velocity_ned_m_s": 3, "attitude_rpy_rad": 3}
    fields |= {"rates_frd_rad_s": 3, "rotor_speed_rad_s": 4, "thrust_m_s2": None}
    states = [{name: rng.uniform(-1, 1, size) for name, size in fields.items()} for _ in range(20)]
    found, wanted = commands_of(library, states), commands_of(plain, states)
    np.testing.assert_array_equal(found, wanted)
    assert len(np.unique(found, axis=0)) == len(found)


def test_words_that_the_loader_rejects_do_not_fly(tmp_path):
    policy, own = made("published racing")
    inputs = written(tmp_path, policy, own, race_of_policy(policy)[0], "px4")
    (tmp_path / "made.qjp").write_bytes((tmp_path / "made.qjp").read_bytes()[:-4] + bytes(4))
    sources = write_sources(tmp_path, inputs, 100.0, tmp_path)
    with pytest.raises(InputError, match="cannot fly here: changed: bad checksum"):
        label_of(sources.build(tmp_path), tmp_path)


BAD = {
    "missing": "no such folder",
    ".": "expected one *_report.json",
    "no_c": "qj_check.c: no such file",
    "no_c --listen 5005": "allowed: HOST:PORT",
    "no_c --delay 5": "--delay has no effect without --late",
    "no_c --simulator effects.gusts=0": "no effect with --simulator",
    "no_c --wrong-unit rates=turns": "--wrong-unit rates=turns, allowed:",
    "no_c --drop 2": "allowed: a number, 0 to 1",
    "no_c --speed 0": "allowed: a number, 0.01",
    "no_c wings=2": "wings",
}


def test_bad_input_is_one_line(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    policy, own = made("published racing")
    inputs = Inputs(Options("made"), policy, race_of_policy(policy)[0], own, "made.npz", "")
    (tmp_path / "no_c").mkdir()
    for words, expected in BAD.items():
        with monkeypatch.context() as patch:
            if words.startswith("no_c"):
                patch.setattr(sil, "read_inputs", lambda *_: inputs)
                patch.setattr(sil, "make_world", lambda *_: Counting())
            assert run("sil", *words.split()) == 2
        lines = capfd.readouterr().err.strip().splitlines()
        assert expected in lines[-1] and lines[-1].startswith("error: ")
        assert not (tmp_path / "runs").exists()


@pytest.mark.slow
def test_a_policy_of_earlier_steps_keeps_its_steps_at_another_rate(tmp_path):
    policy, own = made("indi and more")
    library, _ = in_this_process(tmp_path, "cortex-m7", policy, own, rate=500.0)
    rng = np.random.default_rng(3)
    fields = {"position_ned_m": 3, "velocity_ned_m_s": 3, "attitude_rpy_rad": 3}
    states = [{name: rng.uniform(-1, 1, size) for name, size in fields.items()} for _ in range(40)]
    found = commands_of(library, states, step=0.002)
    np.testing.assert_array_equal(found, np.repeat(found[::5], 5, axis=0))
    assert len(np.unique(found, axis=0)) == 8
    inputs = written(tmp_path / "odd", policy, own, race_of_policy(policy)[0], "cortex-m7")
    sources = write_sources(tmp_path / "odd", inputs, 130.0, tmp_path / "odd")
    with pytest.raises(InputError, match="no whole number of calls is a step of it, within 3%"):
        label_of(sources.build(tmp_path / "odd"), tmp_path)


def test_a_machine_without_compiler_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(toolchain.shutil, "which", lambda name: None)
    monkeypatch.setattr(toolchain, "has_module", lambda name: False)
    policy, own = made("published racing")
    inputs = written(tmp_path, policy, own, race_of_policy(policy)[0], "cortex-m7")
    with pytest.raises(InputError, match="no C compiler on this machine"):
        write_sources(tmp_path, inputs, 100.0, tmp_path).build(tmp_path)
