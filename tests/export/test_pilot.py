"""The pilot in the glue of every autopilot, compiled against stand-ins of its headers."""

import ctypes
import dataclasses
import subprocess
from pathlib import Path

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.files import write_bytes
from quadjax.export import emulator
from quadjax.export.conversion import Options
from quadjax.export.convert import export_c
from quadjax.export.race_source import own_race
from quadjax.export.targets import PX4_MODULE, TARGETS, check_target, target_of
from quadjax.export.verify.build import Sources, load_library
from quadjax.export.verify.result import Skipped
from quadjax.export.verify.toolchain import WARNINGS, arm_none_eabi, host
from tests.export.support import need, untrained
from tests.export.test_layouts import converted_in, made

STUBS = Path(__file__).parent
PX4_FLAGS = (
    "-std=gnu++14 -O2 -Wall -Wextra -Werror -Wdouble-promotion -Wfloat-equal -Wshadow "
    "-fno-exceptions -fno-rtti -fno-gnu-unique -shared -fPIC"
).split()
CRAZYFLIE_FLAGS = (
    "-std=gnu11 -Wall -Wextra -Werror -Wmissing-braces -fno-strict-aliasing -Wdouble-promotion "
    "-Wno-missing-field-initializers -fno-math-errno"
).split()
INDIFLIGHT_FLAGS = "-std=c99 -Wall -Wextra -Wdouble-promotion -Werror".split()
PX4_PLACES = [
    1,
    3,
    0,
    2,
]  # motors 1 to 4 by default: front-right, rear-left, front-left, rear-right
CRAZYFLIE_PLACES = [1, 2, 3, 0]  # M1 .. M4: front-right, rear-right, rear-left, front-left
INDIFLIGHT_PLACES = [2, 1, 3, 0]  # rear-right, front-right, rear-left, front-left
FLIP = np.array([1, -1, -1], np.float32)  # forward-left-up to forward-right-down


def without_rotors():
    """An untrained policy that observes its last action in place of rotor speeds."""
    overrides = ["vehicle=5inch", "observation.actuators=false", "observation.last_action=true"]
    config = load_config("e2e", [*overrides, "network.hidden=[8]", "track.generate.seed=1"])
    policy = untrained(config)
    layers = tuple((np.asarray(k) * 0.3, np.asarray(b) + 0.01) for k, b in policy.layers)
    return dataclasses.replace(policy, layers=layers), own_race(config, policy, "test")


def pointer(array):
    return array.ctypes.data_as(ctypes.c_void_p)


def quaternion_of(angles):
    """w, x, y, z of roll, pitch and yaw."""
    (cr, cp, cy), (sr, sp, sy) = (f(angles.astype(np.float64) / 2) for f in (np.cos, np.sin))
    return np.array([cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy,
                     cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy])  # fmt: skip


class Glue:
    """The files of an export for one target, compiled; the words may be changed."""

    def __init__(self, target, policy, own, folder, change=lambda words: words, rate=500.0):
        self.converted = converted_in(folder, policy, own, target, rate)
        self.folder = folder
        vars(self.converted)["words"] = change(self.converted.words)
        for name, data in self.converted.files().items():
            write_bytes(folder / name, data)
        self.library = self.build()
        self.wrong = self.start()

    def sources(self, where):
        return [self.folder / where / name for name in
                (p.name for p in sorted((self.folder / where).glob("*.c")))]  # fmt: skip


class Paparazzi(Glue):
    calls = 5  # at 512 Hz, in 0.01 s

    def build(self):
        modules = self.folder / "modules"
        modules.mkdir()
        (modules / "quadjax").symlink_to(self.folder / "paparazzi")
        flags = ["-std=gnu99", "-DPREFLIGHT_CHECKS=1", "-DPERIODIC_TELEMETRY=1",
                 f"-I{self.folder}", f"-isystem{STUBS / 'paparazzi_stubs'}"]  # fmt: skip
        files = [p for p in self.sources("paparazzi") if p.name != "qj_angles.c"]
        files.append(STUBS / "paparazzi_stubs/stub_main.c")
        return load_library(host(), files, self.folder / "pprz.so", [*WARNINGS[:4], *flags])

    def start(self):
        return self.library.stub_start()

    def telemetry(self):
        """The numbers of the status message."""
        self.library.stub_sent.restype = ctypes.POINTER(ctypes.c_float)
        return self.library.stub_sent()[:15]

    def step(self, row, flying=True):
        """With a row of 22 numbers, also specific force and body velocity."""
        sensors = row[16:] if len(row) > 16 else [0.0, 0.0, -row[12], 0.0, 0.0, 0.0]
        state = np.float32([*row[:9], *quaternion_of(row[6:9]), *row[9:16], *sensors])
        out = np.zeros(4, np.float32)
        self.flags = self.library.stub_step(pointer(state), int(flying), self.calls, pointer(out))
        return out


class Indiflight(Glue):
    calls = 5  # at 500 Hz, in 0.01 s

    def build(self):
        where = self.folder / "indiflight"
        files = [where / "neural_network.c", where / "nn_controller.c"]
        return load_library(host(), files, self.folder / "nn.so", [*INDIFLIGHT_FLAGS, "-lm"])

    def start(self):
        self.library.nn_load.restype = ctypes.c_char_p
        return self.library.nn_load()

    def step(self, row, flying=True):
        if not flying:
            self.library.nn_reset()
            return np.zeros(4)
        world = np.float32(np.concatenate([row[:12], row[12:][INDIFLIGHT_PLACES]]))
        out = np.zeros(4, np.float32)
        for _ in range(self.calls):
            self.library.nn_control(pointer(world), pointer(out))
        return by_place(out, INDIFLIGHT_PLACES)


class Px4(Glue):
    geometry = 0

    def build(self):
        need("g++")
        module = self.folder / PX4_MODULE
        own = [f"-I{module}", f"-I{STUBS / 'px4_stubs'}", "-DQJ_STATIC=1"]
        own += [f'-DQUADJAX_POLICY_FILE="{self.folder / "made.qjp"}"']
        objects = []
        for source in self.sources(PX4_MODULE):
            objects.append(self.folder / f"{source.stem}.o")
            host().build([source], objects[-1], [*WARNINGS, *own, "-fPIC", "-c"])
        sources = [module / "QuadjaxPolicy.cpp", STUBS / "px4_stubs/stub_main.cpp", *objects]
        output = self.folder / "px4.so"
        command = ["g++", *PX4_FLAGS, *own, *map(str, sources), "-o", str(output)]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return ctypes.CDLL(str(output))

    def start(self):
        return self.library.stub_start(self.geometry)

    def step(self, row, flying=True, lost=0):
        """Motors by place, -1 where none were published; ``ready`` is whether it may run."""
        rotors = row[12:][PX4_PLACES]
        state = np.float32(np.concatenate([row[:6], quaternion_of(row[6:9]), row[9:12], rotors]))
        motors, ready = np.zeros(4, np.float32), ctypes.c_int()
        self.library.stub_step(
            pointer(state), int(flying), lost, pointer(motors), ctypes.byref(ready)
        )
        self.ready = bool(ready.value)
        return by_place(motors, PX4_PLACES)


class Crazyflie(Glue):
    now = 0

    def build(self):
        source = self.folder / "crazyflie/src"
        flags = [f"-I{source}", f"-I{STUBS / 'crazyflie_stubs'}", "-DQJ_STATIC=1"]
        files = [*source.glob("*.c"), STUBS / "crazyflie_stubs/stub_main.c"]
        try:
            for path in source.glob("*.c"):
                arm_none_eabi("Cortex-M4").build(
                    [path], self.folder / "m4.o", [*flags, *CRAZYFLIE_FLAGS, "-c"]
                )
        except Skipped:
            pass
        return load_library(host(), files, self.folder / "cf.so", [*flags, *CRAZYFLIE_FLAGS, "-lm"])

    def start(self):
        self.library.controllerOutOfTreeInit()
        self.library.controllerOutOfTreeTest.restype = ctypes.c_bool
        return not self.library.controllerOutOfTreeTest()

    def step(self, row, flying=True):
        q = quaternion_of(row[6:9]) * np.append(1.0, FLIP)
        parts = [row[:3] * FLIP, row[3:6] * FLIP, q, np.rad2deg(row[9:12] * FLIP)]
        state, motors = np.float32(np.concatenate(parts)), np.zeros(4, np.float32)
        for _ in range(10):  # at 1 kHz
            self.now += 1
            self.library.stub_step(pointer(state), int(flying), self.now, pointer(motors))
        return by_place(motors, CRAZYFLIE_PLACES)


def by_place(motors, places):
    found = np.zeros(4, np.float32)
    found[places] = motors
    return found


GLUES = {  # target, race and glue; every one of which observes earlier steps
    "paparazzi": ("cortex-a9", "indi and more", Paparazzi),
    "indiflight": ("indiflight", "racing with a history", Indiflight),
    "px4": ("px4", "racing with a history", Px4),
    "crazyflie": ("crazyflie", "without rotors", Crazyflie),
}


def policy_of(name):
    return without_rotors() if name == "without rotors" else made(name)


@pytest.fixture(scope="module")
def glue(request, tmp_path_factory):
    target, race, kind = GLUES[request.param]
    return kind(target, *policy_of(race), tmp_path_factory.mktemp(request.param))


every = pytest.mark.parametrize("glue", GLUES, indirect=True)


def rows_of(rng, count, rate):
    """Position, velocity, Euler angles, rates and rotor speeds by place, or a specific thrust."""
    rows = rng.uniform(-1, 1, (count, 16))
    rows[:, 12:] = rng.uniform(200, 2000, (count, 4))
    rows[:, 12:] = np.float32(np.rint(rows[:, 12:] * 9.549297) * np.float32(0.10471975511965977))
    if rate:
        rows[:, 12:] = np.array([np.rint(9.0 * 1024.0) / 1024.0, 0, 0, 0])
    return rows


def expected(converted, rows):
    """Commands (n, 4) float32 of NumPy along the steps of one race."""
    race, network, unit = (
        converted.fixed.race,
        converted.fixed.network,
        2.0**-converted.fixed.network.fraction_bits,
    )
    ends = (network.command_low, network.command_high)
    states, found, last = [], [], np.float32((ends[0] + ends[1]) * unit / 2)
    target, before = np.zeros(1, int), None
    for row in rows:
        values = {"position": row[:3], "velocity": row[3:6], "euler": row[6:9], "rates": row[9:12],
                  "quaternion": quaternion_of(row[6:9]), "rotor_speed": row[12:],
                  "thrust": row[12:13], "last_command": last}  # fmt: skip
        states.append(np.concatenate([values[name] for name in race.fields]))
        all_ = np.float32(states)
        now = np.int64(
            np.trunc(np.float32(row[:3]).astype(float) * 2.0 ** (30 - race.exponents[0]))
        )[None]
        if before is not None:
            event = emulator.gate_event(race, before, now, target)
            target = (target + (event == emulator.PASSED)) % race.gates
        before = now
        q = emulator.observe(race, all_, np.full(len(all_), target[0]))[0][-1:]
        last = np.float32(emulator.forward_rows(network, q)[0, :4] * np.float32(unit))
        found.append(last)
    return np.array(found)


@every
def test_commands_are_those_of_numpy(glue):
    assert not glue.wrong
    rate = glue.converted.policy.vehicle == "rate"
    rng = np.random.default_rng(1)
    for _ in range(2):  # the second race starts over
        rows = rows_of(rng, 25, rate)
        glue.step(rows[0], flying=False)
        found = np.array([glue.step(row) for row in rows])
        np.testing.assert_allclose(found, expected(glue.converted, rows), atol=2e-5)
        assert len(np.unique(found, axis=0)) == len(found)


@every
def test_numbers_of_any_bits_give_commands_in_range(glue):
    network, rng = glue.converted.fixed.network, np.random.default_rng(3)
    with np.errstate(all="ignore"):
        bits = rng.integers(0, 2**32, (500, 16), dtype=np.uint32).view(np.float32)
        bits[:, 12:] = rng.uniform(-1e8, 1e8, (500, 4))
        found = np.array([glue.step(row) for row in bits])
    unit = 2.0**network.fraction_bits
    assert np.all((found >= network.command_low / unit) & (found <= network.command_high / unit))


@pytest.mark.parametrize("glue", ["px4"], indirect=True)
def test_px4_holds_then_idles_when_something_is_lost(glue):
    row = rows_of(np.random.default_rng(2), 1, False)[0]
    assert np.all(glue.step(row, flying=False) == -1)  # nothing is published
    for lost in (1, 2, 4, 16):
        glue.step(row, flying=False)
        flown = glue.step(row)
        assert glue.ready
        np.testing.assert_array_equal(glue.step(row, lost=lost), flown)
        assert not glue.ready
        for _ in range(12):
            idle = glue.step(row, lost=lost)
        assert not glue.ready and np.array_equal(idle, np.zeros(4))
        assert np.all(glue.step(row) > 0) and glue.ready


def test_px4_refuses_files_and_airframes(tmp_path):
    px4 = Px4("px4", *made("racing with a history"), tmp_path)
    assert not px4.wrong and px4.library.stub_configured() and px4.library.stub_interval() == 10_000
    words, path = px4.converted.words, tmp_path / "made.qjp"
    files = {"whole": words, "none": None, "empty": b"", "cut": words[:-4], "odd": words[:-1],
             "flipped": flipped(words), "large": words + bytes(196608)}  # fmt: skip
    for number, (name, data) in enumerate((*files.items(), ("no X", words))):
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)
        copy = tmp_path / f"{number}.so"  # with its own memory
        copy.write_bytes((tmp_path / "px4.so").read_bytes())
        refused = ctypes.CDLL(str(copy)).stub_start(int(name == "no X"))
        assert bool(refused) == (name != "whole"), name
    assert px4.library.stub_stop() == 1


def flipped(words):
    """Words with one bit of a weight changed, and their own checksum."""
    from tests.export.test_runtime import at_of, edited

    at = at_of(words, "weights")
    return edited(words, {at: int(np.frombuffer(words, "<i4")[at]) ^ 1})


@pytest.mark.slow
@pytest.mark.parametrize("name", GLUES)
def test_a_changed_weight_does_not_fly(name, tmp_path):
    target, race, kind = GLUES[name]
    glue = kind(target, *policy_of(race), tmp_path, flipped)
    assert glue.wrong
    row = rows_of(np.random.default_rng(0), 1, False)[0]
    if name == "px4":
        return  # it asks for no mode
    assert np.array_equal(glue.step(row), np.zeros(4))
    assert name != "paparazzi" or glue.flags == 0 and glue.wrong == 3


def test_policies_that_an_autopilot_cannot_fly_are_refused(tmp_path):
    policy, own = made("published racing")
    converted = converted_in(tmp_path, policy, own, "px4")
    with pytest.raises(
        InputError, match="crazyflie: the policy observes rotor_speed, which Crazyf"
    ):
        check_target(TARGETS["crazyflie"], converted.fixed.network, converted.fixed.race)
    flies = converted_in(tmp_path / "flies", *without_rotors(), "crazyflie")
    network = flies.fixed.network
    check_target(TARGETS["crazyflie"], network, flies.fixed.race)
    uneven = dataclasses.replace(flies.fixed.race, time_step=0.0105)
    with pytest.raises(InputError, match="time step is 0.0105 s, allowed: whole milliseconds"):
        check_target(TARGETS["crazyflie"], network, uneven)
    uneven = dataclasses.replace(flies.fixed.race, time_step=0.003)
    with pytest.raises(InputError, match="time step is 0.003 s, allowed: whole periods of 512"):
        check_target(dataclasses.replace(TARGETS["cortex-m7"], calls=512.0), network, uneven)
    for target in ("px4", "indiflight", "crazyflie"):
        with pytest.raises(
            InputError, match=f"--target {target}: .*'motor', allowed: racing, a2rl"
        ):
            target_of(target, "motor")
    assert target_of("cortex-a9", "racing").folder == "c"
    assert Options("made").target == "cortex-a9"


def test_the_calls_have_the_rate_of_the_export(tmp_path):
    glue = Paparazzi("cortex-a9", *made("e2e with quaternions"), tmp_path, rate=256.0)
    assert not glue.wrong and 'freq="256"' in (tmp_path / "paparazzi/quadjax.xml").read_text()
    files = glue.converted.files()
    sources = Sources.write(glue.converted.target, files, tmp_path / "c", glue.converted.fixed)
    assert sources.call_ns == round(1e9 / 256.0)
    with pytest.raises(InputError, match="the time step is 0.01 s, allowed: whole periods of 256"):
        converted_in(tmp_path, *made("e2e with a history"), "cortex-a9", 256.0)


@pytest.mark.slow
def test_a_users_folder_stays_beside_an_export(tmp_path):
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
