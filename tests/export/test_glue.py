"""The glue of every autopilot in a stand-in for its firmware: commands, refusals, lost signals."""

import contextlib
import ctypes
import dataclasses
import functools

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.core.files import write_bytes
from quadjax.export.convert import export_c
from quadjax.export.pilot_emulator import PilotEmulator
from quadjax.export.suitability import check_target, target_of
from quadjax.export.targets import TARGETS, calls_per_step
from quadjax.export.verify.autopilot import Autopilot, random_vehicles
from quadjax.export.verify.build import FILE, Sources
from quadjax.export.verify.result import Skipped
from quadjax.export.verify.toolchain import WARNINGS, arm_none_eabi
from tests.export.support import converted_in, fixed, made
from tests.export.test_runtime import at_of, edited

GLUES = {  # target: race, every one of which observes earlier steps
    "cortex-a9": "indi and more",
    "indiflight": "racing with a history",
    "px4": "racing with a history",
    "crazyflie": "without rotors",
}
FIRMWARE_FLAGS = {  # with which the firmwares are built
    "cortex-a9": WARNINGS[:4],
    "indiflight": "-Wall -Wextra -Wdouble-promotion -Werror".split(),
    "px4": "-Wall -Wextra -Werror -Wdouble-promotion -Wfloat-equal -Wshadow -Wno-comment".split(),
    "crazyflie": ["-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", "-fno-strict-aliasing",
                  "-Wno-missing-field-initializers", "-fno-math-errno"],
}  # fmt: skip


def flipped(words):
    """Words with one bit of a weight changed, and their own checksum."""
    at = at_of(words, "weights")
    return edited(words, {at: int(np.frombuffer(words, "<i4")[at]) ^ 1})


class Glue:
    """The glue of a target with a policy; its words may be changed."""

    def __init__(self, folder, target, race, change=lambda words: words, rate=500.0, **more):
        self.folder = folder
        self.converted = converted_in(folder / "export", *made(race), target, rate, **more)
        self.fixed = self.converted.fixed
        vars(self.converted)["words"] = change(self.converted.words)
        files = {name: data for name, data in self.converted.files().items() if "/" in name}
        self.sources = Sources.write(self.converted.target, files, folder / "c", self.fixed)
        write_bytes(self.sources.folder / FILE, self.converted.words)
        self.autopilot = Autopilot(self.sources, folder, FIRMWARE_FLAGS[target])
        self.wrong = self.autopilot.wrong
        frequency = 1e9 / self.sources.call_ns
        self.calls, self._now = calls_per_step(frequency, self.fixed.time_step), 0.0

    def call(self, vehicle, flies=True):
        self._now += 1e-3 * self.sources.call_ns
        vehicle["time_us"] = round(self._now)
        return self.autopilot.call(vehicle, flies)

    def step(self, vehicle, flies=True):
        """The command at the end of a step of the policy."""
        return [self.call(vehicle, flies) for _ in range(self.calls)][-1]


@pytest.fixture(scope="module")
def glue(request, tmp_path_factory):
    return Glue(tmp_path_factory.mktemp(request.param), request.param, GLUES[request.param])


every = pytest.mark.parametrize("glue", GLUES, indirect=True)


@every
def test_commands_are_those_of_numpy(glue):
    assert glue.wrong is None
    rows, found = random_vehicles(glue.fixed, 25), []
    for _ in range(2):  # the second race starts over
        emulated = PilotEmulator(glue.fixed, 1)
        assert not glue.step(rows[:1], flies=False).any()
        found = [glue.step(row[None]).copy() for row in rows]
        expected = np.array([emulated.call(row) for row in rows])
        np.testing.assert_allclose(found, expected, atol=2e-5)
        assert len(np.unique(found, axis=0)) == len(found) and glue.autopilot.armed
    if glue.converted.options.target == "crazyflie":
        with contextlib.suppress(Skipped):
            files, options = glue.sources.autopilot()
            options += [*FIRMWARE_FLAGS["crazyflie"], "-c"]
            arm_none_eabi("Cortex-M4").build(files[:1], glue.sources.folder / "m4.o", options)
    if glue.converted.options.target == "cortex-a9":  # what the ground sees
        sent = glue.autopilot.value("paparazzi_sent", ctypes.c_float * 15)
        assert [sent[0], sent[1], sent[6], sent[8]] == [0, 1, 50, 0]


@every
def test_numbers_of_any_bits_give_commands_in_range(glue):
    network, rng = glue.fixed.network, np.random.default_rng(3)
    rows = np.zeros(300, random_vehicles(glue.fixed, 1).dtype)
    for name in rows.dtype.names[1:]:
        bits = rng.integers(0, 2**32, rows[name].shape, dtype=np.uint32)
        rows[name] = bits.view(np.float32)
    found = np.array([glue.step(row[None]) for row in rows])
    unit = 2.0**network.fraction_bits
    assert np.all((found >= network.command_low / unit) & (found <= network.command_high / unit))


def test_sampled_commands_are_those_of_numpy(tmp_path):
    glue = Glue(tmp_path, "cortex-a9", GLUES["cortex-a9"], sampled=True)
    emulated = PilotEmulator(glue.fixed, 1)
    for row in random_vehicles(glue.fixed, 10):
        np.testing.assert_array_equal(glue.step(row[None]), emulated.call(row))
    assert glue.fixed.noise is not None


@pytest.mark.parametrize("glue", ["px4"], indirect=True)
def test_px4_holds_then_idles_when_something_is_lost(glue):
    row, lost = random_vehicles(glue.fixed, 1), glue.autopilot.value("px4_lost", ctypes.c_uint)
    for topic in range(4):
        glue.step(row, flies=False)
        flown = glue.step(row).copy()
        assert glue.autopilot.armed
        lost.value = 1 << topic
        np.testing.assert_array_equal(glue.step(row), flown)
        assert not glue.autopilot.armed
        for _ in range(12):
            idle = glue.step(row)
        assert not glue.autopilot.armed and not idle.any()
        lost.value = 0
        assert np.all(glue.step(row) > 0) and glue.autopilot.armed


@pytest.mark.parametrize("glue", ["px4"], indirect=True)
def test_px4_refuses_files_and_airframes(glue, tmp_path):
    assert glue.autopilot.value("px4_interval", ctypes.c_uint).value == 10_000
    words, path = glue.converted.words, glue.sources.folder / FILE
    files = {"whole": words, "none": None, "empty": b"", "cut": words[:-4], "odd": words[:-1],
             "flipped": flipped(words), "large": words + bytes(196608), "no X": words}  # fmt: skip
    for number, (name, data) in enumerate(files.items()):
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        copy = tmp_path / f"{number}.so"  # with its own memory
        copy.write_bytes((glue.folder / "glue.so").read_bytes())
        library = ctypes.CDLL(str(copy))
        ctypes.c_uint.in_dll(library, "px4_geometry").value = name == "no X"
        assert bool(library.firmware_start()) == (name != "whole"), name
        assert name != "whole" or library.px4_mode() == 1
    path.write_bytes(words)


@pytest.mark.slow
@pytest.mark.parametrize("target", sorted(GLUES.keys() - {"px4"}))
def test_a_changed_weight_does_not_fly(target, tmp_path):
    glue = Glue(tmp_path, target, GLUES[target], flipped)
    assert glue.wrong == "self-test fails"
    assert not glue.step(random_vehicles(glue.fixed, 1)).any() and not glue.autopilot.armed


def checked(target, race="without rotors", **changes):
    """A check of a policy whose race, or whose target, has other numbers."""

    def check(folder):
        policy = fixed(race)[1]
        check_target(target, policy.network, dataclasses.replace(policy.race, **changes))

    return check


SLOW_CALLS = dataclasses.replace(TARGETS["cortex-m7"], calls=512.0)
REFUSED = {
    "crazyflie: the policy observes rotor_speed, which Crazyf": checked(
        TARGETS["crazyflie"], "published racing"
    ),
    "time step is 0.0105 s, allowed: whole milliseconds": checked(
        TARGETS["crazyflie"], time_step=0.0105
    ),
    "time step is 0.003 s, allowed: whole periods of 512": checked(SLOW_CALLS, time_step=0.003),
    "the time step is 0.01 s, allowed: whole periods of 256": lambda folder: converted_in(
        folder, *made("e2e with a history"), "cortex-a9", 256.0
    ),
} | {
    f"--target {name}: .*'motor', allowed: racing, a2rl": functools.partial(
        lambda name, folder: target_of(name, "motor"), name
    )
    for name in ("px4", "indiflight", "crazyflie")
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_an_autopilot_cannot_fly_is_refused(message, tmp_path):
    with pytest.raises(InputError, match=message):
        REFUSED[message](tmp_path)
    checked(TARGETS["crazyflie"])(tmp_path)
    assert target_of("cortex-a9", "racing").folder == "c"


def test_the_calls_have_the_rate_of_the_export(tmp_path):
    glue = Glue(tmp_path, "cortex-a9", "e2e with quaternions", rate=256.0)
    module = glue.sources.include / "quadjax.xml"
    assert glue.wrong is None and 'freq="256"' in module.read_text()
    assert glue.sources.call_ns == round(1e9 / 256.0)


def test_a_users_folder_stays_next_to_an_export(tmp_path, no_flights):
    policy, _ = made("published racing")
    policy.save(tmp_path / "policy.npz")
    out, own = tmp_path / "out", tmp_path / "out/c/mine.c"
    write_bytes(own, b"int mine;")
    ranges = {"position": 64.0, "velocity": 128.0, "rates": 1024.0, "attitude": 4.0}
    for target in ("px4", "indiflight"):
        options = {"name": "made", "allow_unfinished": True, "overwrite": True}
        export_c(tmp_path / "policy.npz", out, ranges=ranges, target=target, **options)
    assert own.read_bytes() == b"int mine;" and not (out / "px4").exists()
    assert (out / "indiflight/nn_controller.c").exists()
