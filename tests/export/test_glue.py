"""The glue of every autopilot in a stand-in for its firmware: commands, refusals, lost signals."""

import ctypes

import numpy as np
import pytest

from quadjax.core.files import write_bytes
from quadjax.export.convert import export_c
from quadjax.export.pilot_emulator import PilotEmulator
from quadjax.export.targets import calls_per_step
from quadjax.export.verify.autopilot import Autopilot, random_vehicles
from quadjax.export.verify.build import Sources
from quadjax.export.verify.toolchain import WARNINGS
from tests.export.support import WIDE, converted_in, made
from tests.export.words import with_flipped_weight

GLUES = {  # target: race, every one of which observes its last action
    "cortex-a9": "everything",
    "indiflight": "racing, axes and more",
}
FIRMWARE_FLAGS = {  # with which the firmwares are built
    "cortex-a9": WARNINGS[:4],
    "indiflight": "-Wall -Wextra -Wdouble-promotion -Werror".split(),
}


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


@every
def test_commands_are_those_of_numpy(glue):
    assert glue.wrong is None
    rows, target = random_vehicles(25), glue.converted.options.target
    for race in range(1 if target == "cortex-a9" else 2):  # the second race starts over
        assert race == 0 or not glue.step(rows[:1], flies=False).any()
        found = [glue.step(row[None]).copy() for row in rows]
        np.testing.assert_allclose(found, glue.emulated(rows), atol=2e-5)
        assert len(np.unique(found, axis=0)) == len(found) and glue.autopilot.armed
    if target == "cortex-a9":  # what the ground sees
        sent = glue.autopilot.value("paparazzi_sent", ctypes.c_float * 15)
        assert [sent[0], sent[1], sent[6], sent[8]] == [0, 1, 25, 0]


@every
def test_numbers_of_any_bits_give_commands_in_range(glue):
    network, rng = glue.fixed.network, np.random.default_rng(3)
    rows = np.zeros(300, random_vehicles(1).dtype)
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
    rows = random_vehicles(10)
    for _ in range(1 if sampled else 2):  # the noise does not start over
        found = [glue.step(row[None]).copy() for row in rows]
        np.testing.assert_array_equal(found, glue.emulated(rows))
        assert not glue.step(rows[:1], flies=False).any()
    assert (glue.fixed.noise is not None) == sampled


@pytest.mark.slow
@pytest.mark.parametrize("target", sorted(GLUES))
def test_a_changed_weight_does_not_fly(target, tmp_path):
    glue = Glue(tmp_path, target, change=with_flipped_weight)
    assert glue.wrong == "self-test fails"
    assert not glue.step(random_vehicles(1)).any() and not glue.autopilot.armed


@pytest.mark.slow
def test_the_calls_have_the_rate_of_the_export(tmp_path):
    glue = Glue(tmp_path, "cortex-a9", "e2e with quaternions", rate=256.0)
    module = glue.sources.include / "quadjax.xml"
    assert glue.wrong is None and 'freq="256"' in module.read_text()
    assert glue.sources.call_ns == round(1e9 / 256.0)


def test_a_users_folder_stays_next_to_an_export(tmp_path, no_flights):
    policy, out = made("published racing")[0], tmp_path / "out"
    write_bytes(out / "c/mine.c", b"int mine;")
    for target in ("qjp", "indiflight"):
        options = {"name": "made", "allow_unfinished": True, "overwrite": True}
        export_c(policy, out, ranges=WIDE, target=target, **options)
    assert (out / "c/mine.c").read_bytes() == b"int mine;" and not (out / "qjp").exists()
    assert (out / "indiflight/nn_controller.c").exists()
