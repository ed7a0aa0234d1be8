"""Exported C as a process: the bits of the same C in this process, and the command's files."""

import contextlib
import ctypes
import dataclasses
import json
import threading
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest

from quadjax.cli import sil as command
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED
from quadjax.export.conversion import Options
from quadjax.export.folder import Inputs
from quadjax.export.race_source import own_race
from quadjax.export.verify import toolchain
from quadjax.flights import load
from quadjax.flights.flight import SIMULATED
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.sil import run as sil
from quadjax.sil.fly import set_floats
from quadjax.sil.message import DTYPES, HEADER, RPM_PER_RAD_S, Kind, new
from quadjax.sil.run import Setting, fly_all, make_world
from quadjax.sil.source import build_autopilot, label_of
from tests.commands import run
from tests.export.test_layouts import converted_in, made
from tests.export.test_pilot import without_rotors
from tests.sil.support import Counting

PLANT = load_plant_config("standin")
STEPS = 150
SIZE = (DTYPES[Kind.STATE].itemsize - HEADER.itemsize) // 4 - 2  # floats of a state


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


def loaded(folder, inputs, rate):
    """The C behind the messages as a library, at the start of a race, and its sources."""
    path, sources = build_autopilot(folder, inputs, rate, folder, shared=True)
    library = ctypes.CDLL(str(path))
    assert library.sil_load() == 0
    library.sil_begin()
    return library, sources


def command_of(library, time_s, numbers):
    """The command (4,) for the floats of a state."""
    state, command = new(Kind.STATE, time_s=time_s), new(Kind.COMMAND)
    set_floats(state, np.float32(numbers))
    library.sil_step(*(x.ctypes.data_as(ctypes.c_void_p) for x in (state, command)))
    return command["command"]


def flown_in_this_process(inputs, plant, folder, steps):
    """The motion and the commands (steps, ..) of the C called through ctypes, step by step."""
    world = make_world(inputs.config, inputs.policy, plant, 1)
    library, _ = loaded(folder, inputs, 1.0 / world.step)
    factor = RPM_PER_RAD_S if world.model.name == "motor" else 1.0
    now, rows = world.begin(0), []
    for number in range(steps):
        sent = command_of(library, number * world.step, now.numbers).astype(np.float64)
        wanted = np.float32(np.clip(sent * factor, *world.ranges()))
        rows.append(np.concatenate([now.true, wanted]))
        now = world.advance(now, wanted)
    return np.array(rows)


def short(world):
    """The same world with a time limit of a few steps."""
    return dataclasses.replace(world, limit=min(STEPS, world.limit))


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
    expected = flown_in_this_process(inputs, plant, tmp_path, len(rows))
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


def flown_alone(folder, target, policy, own, rate=None, count=20):
    """Commands (count, 4) of a target's C in random states, and its sources."""
    inputs = written(folder, policy, own, race_of_policy(policy)[0], target)
    rate = rate or 1.0 / own.time_step
    library, sources = loaded(folder, inputs, rate)
    numbers = np.random.default_rng(3).uniform(-1, 1, (count, 40))
    commands = [command_of(library, n / rate, row[:SIZE]).copy() for n, row in enumerate(numbers)]
    return np.array(commands), sources


OTHERS = [("qjp", "indi and more"), ("qjp", "published racing"), ("crazyflie", "without rotors")]


@pytest.mark.parametrize(
    ("target", "race"),
    [("px4", "published racing"), *(pytest.param(*x, marks=pytest.mark.slow) for x in OTHERS)],
)
def test_every_target_flies_the_same_runtime(target, race, tmp_path):
    policy, own = without_rotors() if race == "without rotors" else made(race)
    found, sources = flown_alone(tmp_path / target, target, policy, own)
    assert "qj_load.c,qj_network.c" in sources and sources.count("made") == 1
    assert sources.startswith("made.qjp, ") and ("without" in sources) == (target != "qjp")
    wanted, others = flown_alone(tmp_path / "c", "cortex-m7", policy, own)
    assert others.startswith("made.qjp, c/{qj_check.c")
    np.testing.assert_array_equal(found, wanted)
    assert len(np.unique(found, axis=0)) == len(found)


def test_damaged_words_do_not_fly_and_are_named(tmp_path):
    policy, own = made("published racing")
    inputs = written(tmp_path, policy, own, race_of_policy(policy)[0], "px4")
    words = (tmp_path / "made.qjp").read_bytes()
    for damaged in (words[:-4] + bytes(4), words + b"x", b""):
        (tmp_path / "made.qjp").write_bytes(damaged)
        with pytest.raises(InputError, match=r"made.qjp: (changed since|.* bytes, which no)"):
            build_autopilot(tmp_path, inputs, 100.0, tmp_path)


BAD = {
    "made/made.qjp": "made: expected one *_report.json",
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
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / ".quadjax.json").write_text('{"kind": "export"}')
    (tmp_path / "made" / "made.qjp").write_bytes(b"")
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
    found, _ = flown_alone(tmp_path, "cortex-m7", policy, own, rate=500.0, count=40)
    np.testing.assert_array_equal(found, np.repeat(found[::5], 5, axis=0))
    assert len(np.unique(found, axis=0)) == 8
    inputs = written(tmp_path / "odd", policy, own, race_of_policy(policy)[0], "cortex-m7")
    program, _ = build_autopilot(tmp_path / "odd", inputs, 130.0, tmp_path / "odd")
    with pytest.raises(InputError, match="no whole number of calls is a step of it, within 3%"):
        label_of(program, tmp_path / "odd" / "made.qjp")


def test_ctrl_c_before_the_first_step_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "c").mkdir()
    stop = threading.Event()
    stop.set()
    peer = SimpleNamespace(rejected=Counter(), rejected_before=0, stopped=True)
    policy, own = made("published racing")
    inputs = Inputs(Options("made"), policy, race_of_policy(policy)[0], own, "made.npz", "")
    monkeypatch.setattr(command, "interruptions", lambda _: contextlib.nullcontext(stop))
    monkeypatch.setattr(sil, "read_inputs", lambda *_: inputs)
    monkeypatch.setattr(sil, "make_world", lambda *_: Counting())
    started = contextlib.nullcontext((peer, "exported C", ""))
    monkeypatch.setattr(sil, "_autopilot", lambda *_: started)
    assert run("sil", "c") == 130
    assert not (tmp_path / "runs").exists()


def test_a_machine_without_compiler_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(toolchain.shutil, "which", lambda name: None)
    monkeypatch.setattr(toolchain, "has_module", lambda name: False)
    policy, own = made("published racing")
    inputs = written(tmp_path, policy, own, race_of_policy(policy)[0], "cortex-m7")
    with pytest.raises(InputError, match="no C compiler on this machine"):
        build_autopilot(tmp_path, inputs, 100.0, tmp_path)
