"""The glue of every autopilot in a stand-in for its firmware: commands, refusals, lost signals."""

import contextlib
import ctypes

import numpy as np
import pytest

from quadjax.core.files import write_bytes
from quadjax.export.convert import export_c
from quadjax.export.pilot_emulator import PilotEmulator
from quadjax.export.targets import calls_per_step
from quadjax.export.verify.autopilot import Autopilot, random_vehicles
from quadjax.export.verify.build import FILE, Sources
from quadjax.export.verify.result import Skipped
from quadjax.export.verify.toolchain import WARNINGS, arm_none_eabi
from tests.export.support import WIDE, converted_in, made
from tests.export.words import with_flipped_weight

GLUES = {  # target: race, every one of which observes earlier steps
    "cortex-a9": "everything",
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


class Glue:
    """The glue of a target with a policy; its words may be changed."""

    def __init__(self, folder, target, race=None, change=lambda words: words, rate=500.0, **more):
        self.folder = folder
        race = made(race or GLUES[target])
        self.converted = converted_in(folder / "export", *race, target, rate, **more)
        self.fixed = self.converted.fixed
        vars(self.converted)["words"] = change(self.converted.words)
        files = {name: data for name, data in self.converted.files().items() if "/" in name}
        self.sources = Sources.write(self.converted.target, files, folder / "c", self.fixed)
        write_bytes(self.sources.folder / FILE, self.converted.words)
        self.autopilot = Autopilot(self.sources, folder, FIRMWARE_FLAGS[target])
        self.wrong = self.autopilot.wrong
        frequency = 1e9 / self.sources.call_ns
        self.calls, self._now = calls_per_step(frequency, self.fixed.race.time_step), 0.0

    def step(self, vehicle, flies=True):
        """The command at the end of a step of the policy."""
        for _ in range(self.calls):
            self._now += 1e-3 * self.sources.call_ns
            vehicle["time_us"] = round(self._now)
            command = self.autopilot.call(vehicle, flies)
        return command

    def emulated(self, rows):
        """Commands (n, 4) of NumPy for a state a step, from the start of a race."""
        emulator = PilotEmulator(self.fixed, self.calls)
        return np.array([[emulator.call(row) for _ in range(self.calls)][-1] for row in rows])


@pytest.fixture(scope="module")
def glue(request, tmp_path_factory):
    return Glue(tmp_path_factory.mktemp(request.param), request.param)


every = pytest.mark.parametrize("glue", GLUES, indirect=True)
px4 = pytest.mark.parametrize("glue", ["px4"], indirect=True)


@every
def test_commands_are_those_of_numpy(glue):
    assert glue.wrong is None
    rows, target = random_vehicles(glue.fixed, 25), glue.converted.options.target
    for race in range(1 if target == "cortex-a9" else 2):  # the second race starts over
        assert race == 0 or not glue.step(rows[:1], flies=False).any()
        found = [glue.step(row[None]).copy() for row in rows]
        np.testing.assert_allclose(found, glue.emulated(rows), atol=2e-5)
        assert len(np.unique(found, axis=0)) == len(found) and glue.autopilot.armed
    if target == "crazyflie":
        with contextlib.suppress(Skipped):
            files, options = glue.sources.autopilot()
            options += [*FIRMWARE_FLAGS["crazyflie"], "-c"]
            arm_none_eabi("Cortex-M4").build(files[:1], glue.sources.folder / "m4.o", options)
    if target == "cortex-a9":  # what the ground sees
        sent = glue.autopilot.value("paparazzi_sent", ctypes.c_float * 15)
        assert [sent[0], sent[1], sent[6], sent[8]] == [0, 1, 25, 0]


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


@pytest.mark.slow
@pytest.mark.parametrize("sampled", [False, True])
def test_paparazzi_gets_rates_and_thrust(sampled, tmp_path):
    glue = Glue(tmp_path, "cortex-a9", "indi and more", sampled=sampled)
    rows = random_vehicles(glue.fixed, 10)
    for _ in range(1 if sampled else 2):  # the noise does not start over
        found = [glue.step(row[None]).copy() for row in rows]
        np.testing.assert_array_equal(found, glue.emulated(rows))
        assert not glue.step(rows[:1], flies=False).any()
    assert (glue.fixed.noise is not None) == sampled


@px4
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


@px4
def test_px4_refuses_files_and_airframes(glue, tmp_path):
    assert glue.autopilot.value("px4_interval", ctypes.c_uint).value == 10_000
    words, path = glue.converted.words, glue.sources.folder / FILE
    files = {"whole": words, "none": None, "empty": b"", "cut": words[:-4], "odd": words[:-1],
             "flipped": with_flipped_weight(words), "large": words + bytes(196608),
             "no X": words}  # fmt: skip
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
    glue = Glue(tmp_path, target, change=with_flipped_weight)
    assert glue.wrong == "self-test fails"
    assert not glue.step(random_vehicles(glue.fixed, 1)).any() and not glue.autopilot.armed


@pytest.mark.slow
def test_the_calls_have_the_rate_of_the_export(tmp_path):
    glue = Glue(tmp_path, "cortex-a9", "e2e with quaternions", rate=256.0)
    module = glue.sources.include / "quadjax.xml"
    assert glue.wrong is None and 'freq="256"' in module.read_text()
    assert glue.sources.call_ns == round(1e9 / 256.0)


def test_a_users_folder_stays_next_to_an_export(tmp_path, no_flights):
    policy, out = made("published racing")[0], tmp_path / "out"
    write_bytes(out / "c/mine.c", b"int mine;")
    for target in ("px4", "indiflight"):
        options = {"name": "made", "allow_unfinished": True, "overwrite": True}
        export_c(policy, out, ranges=WIDE, target=target, **options)
    assert (out / "c/mine.c").read_bytes() == b"int mine;" and not (out / "px4").exists()
    assert (out / "indiflight/nn_controller.c").exists()
