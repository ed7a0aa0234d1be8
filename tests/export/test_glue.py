"""The glue of every autopilot in a stand-in for its firmware: commands, refusals, whole races."""

import ctypes
import threading
from pathlib import Path

import numpy as np
import pytest

from quadjax.core.resources import PRETRAINED
from quadjax.export.library import VEHICLE
from quadjax.export.race_source import policy_race
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.sil import run
from quadjax.sil.faults import Faults
from quadjax.sil.run import Setting, fly_all
from tests.export.stand_ins import Firmware
from tests.export.support import WARNINGS, convert, converted, library

RACER = Path(__file__).parent / "racer.npz"  # of the 5-inch drone, without rotor speeds
GLUES = {"cortex-a9": "everything", "indiflight": "racing, axes and more"}  # target: race
FLAGS = {  # with which the firmwares are built
    "cortex-a9": (*WARNINGS[:4], "-Werror"),
    "indiflight": tuple("-Wall -Wextra -Wdouble-promotion -Werror".split()),
}
THRUST_GAIN, HOVER, CUTOFF = 500.0, 9.81, 8.0  # autopilot units per m/s^2, m/s^2, Hz


def random_vehicles(count):
    """States (count,) in flight, in numbers that every autopilot represents."""
    rng, vehicles = np.random.default_rng(1), np.zeros(count, VEHICLE)
    for name in ("position", "velocity", "rates", "body_velocity"):
        vehicles[name] = rng.uniform(-1.0, 1.0, (count, 3))
    turned = rng.standard_normal((count, 4)) * [0.2, 0.2, 0.2, 0.2] + [1, 0, 0, 0]
    vehicles["quaternion"] = turned / np.linalg.norm(turned, axis=1, keepdims=True)
    rpm = np.rint(rng.uniform(3000.0, 10_000.0, (count, 4)))
    vehicles["rotor_speed"] = rpm / np.float32(30.0 / np.pi)
    vehicles["specific_force"] = np.rint(rng.uniform(-9.0, 9.0, (count, 3)) * 1024.0) / 1024.0
    vehicles["autopilot_command"] = rpm
    return vehicles


class Glue:
    """The glue of a target with a policy, next to the pilot alone."""

    def __init__(self, folder, target, race=None, **more):
        self.of = converted(race or GLUES[target], folder / "policy", target=target, **more)
        self.firmware = Firmware(self.of, folder / "glue", FLAGS[target])
        self.pilot = library(self.of, folder / "c").pilot(self.of.frequency)

    def both(self, rows, flies=True):
        """Commands (n, 4) of the glue and of the pilot for a state a call."""
        found, wanted = [], []
        for number, row in enumerate(rows[:, None]):
            now = round(1e6 * number / self.of.frequency)
            row["time_us"] = row["position_us"] = now
            found.append(self.firmware.call(now, row, flies))
            wanted.append(self.pilot.call(now, row)[1])
        return np.array(found), np.array(wanted)


@pytest.fixture(scope="module")
def glue(request, tmp_path_factory):
    return Glue(tmp_path_factory.mktemp(request.param), request.param)


every = pytest.mark.parametrize("glue", GLUES, indirect=True)


@every
def test_commands_are_those_of_the_pilot(glue):
    assert glue.firmware.wrong is None
    rows = np.repeat(random_vehicles(40), 5)  # a step of the policy is five calls
    glue.firmware.begin()
    glue.pilot.standby(np.zeros((), VEHICLE))
    found, wanted = glue.both(rows)
    span = wanted.max() - wanted.min()
    np.testing.assert_allclose(found, wanted, atol=2e-4 * span)
    assert len(np.unique(found, axis=0)) == 40 and glue.firmware.armed
    if glue.of.target.glue == "paparazzi":  # what the ground sees
        sent = (ctypes.c_float * 12).in_dll(glue.firmware._library, "paparazzi_sent")
        assert [sent[0], sent[1], sent[6], sent[8]] == [0, 1, 40, 0]
    assert not glue.firmware.call(10**6, rows[:1], flies=False).any()


@every
def test_numbers_of_any_bits_give_commands_in_range(glue):
    rng, rows = np.random.default_rng(3), random_vehicles(300)
    for name in rows.dtype.names[2:]:
        bits = rng.integers(0, 2**32, rows[name].shape, dtype=np.uint32)
        rows[name] = bits.view(np.float32)
    glue.firmware.begin()
    rows[::2] = random_vehicles(150)
    found, _ = glue.both(rows)
    low, high = glue.of.policy.command_low, glue.of.policy.command_high
    assert np.all((found >= low) & (found <= high))


def test_paparazzi_holds_and_hands_over_where_motion_capture_stops(tmp_path):
    """The rates are new in every call, the position stays as old as its last message."""
    glue = Glue(tmp_path, "cortex-a9")
    row, flown = random_vehicles(1), []
    for call in range(400):
        row["time_us"] = now = round(1e6 * call / glue.of.frequency)
        row["position_us"] = min(now, 100_000)
        row["rates"] = 0.1 * np.sin([call, 2 * call, 3 * call])
        flown.append(glue.firmware.call(now, row).copy())
    moving = np.any(np.diff(flown, axis=0) != 0.0, axis=1) & np.any(flown[1:], axis=1)
    last = 1e6 / glue.of.frequency * (1 + np.flatnonzero(moving))
    commanded = 1e6 / glue.of.frequency * np.flatnonzero(np.any(flown, axis=1))
    assert 185_000 < last.max() <= 202_000  # flies up to an age of 0.1 s
    assert 295_000 < commanded.max() <= 306_000  # holds for 0.1 s, then the autopilot flies


@every
def test_a_changed_weight_does_not_fly(glue, tmp_path):
    target = glue.of.target.name
    of = converted(GLUES[target], tmp_path / "policy", target=target)
    name, first = f"{of.target.folder}/made.h", int(of.in_c.tables[0][0][0])
    text = of.files[name].decode()
    changed = text.replace(f"    {first}, ", f"    {first ^ 1}, ", 1)
    assert changed != text
    vars(of)["files"] = of.files | {name: changed.encode()}
    firmware = Firmware(of, tmp_path / "glue")
    assert firmware.wrong == "its self-test fails"
    assert not firmware.call(0, random_vehicles(1)).any() and not firmware.armed


def test_paparazzis_inner_loop_gets_rates_and_an_increment_of_thrust(tmp_path):
    """What is missing of the commanded specific force is added to the filtered command."""
    glue = Glue(tmp_path, "cortex-a9", "indi and more")
    rows = np.repeat(random_vehicles(20), 5)
    rows["specific_force"][:, 2] = -5.0
    step = 1.0 / 512.0
    gain = step / (1.0 / (2.0 * np.pi * CUTOFF) + step)  # of the stand-in's filters
    felt = HOVER + (5.0 - HOVER) * (1.0 - (1.0 - gain) ** np.arange(1, len(rows) + 1))
    rows["thrust"] = felt  # the glue filters its own
    found, wanted = glue.both(rows)
    np.testing.assert_allclose(found[:, :3], wanted[:, :3], atol=1e-4)
    given, expected = 0.0, 0.0
    for row, (thrust, measured) in enumerate(zip(wanted[:, 3], felt, strict=True)):
        given += gain * (expected - given)
        expected = np.clip(given + THRUST_GAIN * (thrust - measured), 0.0, 9600.0)
        assert abs(found[row, 3] - expected) < 3.0, row
        expected = found[row, 3]
    assert len(np.unique(found[:, 3])) > 10
    assert not glue.firmware.call(10**7, rows[:1], flies=False).any() and glue.firmware.armed


@pytest.mark.slow
def test_the_calls_have_the_rate_of_the_export(tmp_path):
    glue = Glue(tmp_path, "cortex-a9", "e2e with quaternions", sample_rate=256.0)
    assert glue.firmware.wrong is None and glue.of.frequency == 256.0
    assert b'freq="256"' in glue.of.files["paparazzi/quadjax.xml"]
    assert b"QUADJAX_FREQUENCY 256.0F" in glue.of.files["paparazzi/quadjax_policy.h"]


RACES = {  # target, and whether it flies on the plant
    PRETRAINED / "e2e_cyberzoo.npz": ("cortex-a9", True),
    RACER: ("indiflight", False),
    PRETRAINED / "indi_cyberzoo.npz": ("cortex-m7", True),
}


@pytest.mark.slow
@pytest.mark.parametrize("drop", [0.0, 0.1])
@pytest.mark.parametrize("path", RACES, ids=lambda path: path.stem)
def test_every_target_flies_a_whole_race(path, drop, tmp_path, monkeypatch):
    """In lockstep, and with a tenth of the states lost."""
    target, on_plant = RACES[path]
    policy = Policy.load(path)
    config, origin = race_of_policy(policy)
    of = convert(policy, policy_race(config, policy, origin), tmp_path, target)
    monkeypatch.setattr(run, "_converted", lambda setting: (of, setting))
    if of.target.glue:
        monkeypatch.setattr(run, "ExportedC", lambda of, work, rate: Firmware(of, work))
    plant = load_plant_config("cyberzoo") if on_plant else None
    setting = Setting(tmp_path, plant, laps=2, faults=Faults(drop=drop))
    flown = fly_all(setting, threading.Event())
    assert flown.laps.crashes == ("",), flown.text()
    assert (flown.counts.get("states dropped", 0) > 20) == bool(drop)
