"""PX4's module and the Crazyflie's controller, compiled against stand-ins of their headers."""

import ctypes
import dataclasses
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.export import emulator, race_emulator
from quadjax.export.actor import fixed_point_fly
from quadjax.export.fixed import convert
from quadjax.export.qjp.autopilots import (
    CRAZYFLIE_FOLDER,
    PX4_MODULE,
    check_crazyflie,
    check_motor_policy,
    emit_crazyflie,
    emit_px4,
)
from quadjax.export.qjp.policy import make_qjp, qjp_bytes
from quadjax.export.race_source import own_race
from quadjax.export.race_tables import make_tables, track_ranges
from quadjax.export.verify import checks_indiflight
from quadjax.export.verify.harness import load_library
from quadjax.export.verify.result import Skipped
from quadjax.export.verify.toolchain import WARNINGS, arm_none_eabi, host
from quadjax.race import laps
from tests.export.support import named_network, need, random_states, untrained
from tests.export.test_layouts import made

STUBS = Path(__file__).parent
PX4_FLAGS = (
    "-std=gnu++14 -O2 -Wall -Wextra -Werror -Wdouble-promotion -Wfloat-equal -Wshadow "
    "-fno-exceptions -fno-rtti -fno-gnu-unique -shared -fPIC"
).split()
# PX4's motors 1 to 4 by default: front-right, rear-left, front-left, rear-right.
PX4_PLACES = [1, 3, 0, 2]
CRAZYFLIE_PLACES = [1, 2, 3, 0]  # M1 .. M4: front-right, rear-right, rear-left, front-left
RPM = np.float32(0.10471975511965977)


def converted(policy, own):
    """Network, race tables and the bytes of the file."""
    network = convert(policy, track_ranges(policy.layout, own.params.track) | {"position": 32.0})
    race = make_tables(network.box, policy, own.choices, own.params)
    rng = np.random.default_rng(0)
    states = random_states(rng, 20, own, policy.command_low, policy.command_high)
    targets = rng.integers(0, race.gates, 20)
    parts = (network, race, "ab" * 32, own.time_step, None, states, targets)
    return network, race, qjp_bytes(make_qjp("made", *parts))


def without_rotors():
    """An untrained policy that observes its last action in place of rotor speeds."""
    overrides = ["vehicle=5inch", "observation.actuators=false", "observation.last_action=true"]
    config = load_config("e2e", [*overrides, "network.hidden=[8]", "track.generate.seed=1"])
    policy = untrained(config)
    layers = tuple((np.asarray(k) * 0.3, np.asarray(b) + 0.01) for k, b in policy.layers)
    return dataclasses.replace(policy, layers=layers), own_race(config, policy, "test")


def write(files, folder):
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)


def pointer(array):
    return array.ctypes.data_as(ctypes.c_void_p)


def px4_library(network, race, data, folder):
    """The module with its stand-ins; the policy is where its SD card would be."""
    need("g++")
    write(emit_px4(network, race), folder)
    (folder / "policy.qjp").write_bytes(data)
    module = folder / PX4_MODULE
    own = [f"-I{module}", f"-I{STUBS / 'px4_stubs'}", "-DQJP_STATIC=1"]
    own += [f'-DQUADJAX_POLICY_FILE="{folder / "policy.qjp"}"']
    objects = []
    for source in module.glob("*.c"):
        objects.append(folder / f"{source.stem}.o")
        host().build([source], objects[-1], [*WARNINGS, *own, "-fPIC", "-c"])
    sources = [module / "QuadjaxPolicy.cpp", STUBS / "px4_stubs/stub_main.cpp", *objects]
    output = folder / "px4.so"
    command = ["g++", *PX4_FLAGS, *own, *map(str, sources), "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return ctypes.CDLL(str(output))


class Px4:
    """One step of the module for each call."""

    def __init__(self, library):
        self.library = library

    def step(self, state, armed=True, lost=0):
        """Motors (4,) in PX4's order, -1 where none were published, and whether it may run."""
        state, motors = np.ascontiguousarray(state, np.float32), np.zeros(4, np.float32)
        ready = ctypes.c_int()
        self.library.stub_step(pointer(state), armed, lost, pointer(motors), ctypes.byref(ready))
        return motors, bool(ready.value)


def expected_commands(network, race, rows, targets):
    """Commands (n, 4) float32 of states (n, state_size), in the policy's order."""
    q = race_emulator.observe(race, rows, targets).q
    commands = emulator.forward_q(network, q)
    return (commands * np.float32(2.0**-network.fraction_bits)).astype(np.float32)


@pytest.fixture(scope="module")
def px4(tmp_path_factory):
    policy, own = made("published racing")
    network, race, data = converted(policy, own)
    library = px4_library(network, race, data, tmp_path_factory.mktemp("px4"))
    assert library.stub_start(0) == 0 and library.stub_configured()
    return Px4(library), network, race, own


def level_state(rng):
    """A state (17,) near a gate: position, velocity, quaternion, rates, rotor speeds."""
    rpm = rng.integers(2000, 20000, 4).astype(np.float32)
    quaternion = np.array([1.0, 0.1, -0.05, 0.02]) / np.linalg.norm([1.0, 0.1, -0.05, 0.02])
    motion = rng.uniform(-1, 1, 6)
    return np.concatenate([motion, quaternion, rng.uniform(-1, 1, 3), rpm * RPM]).astype("f4")


def euler(q):
    w, x, y, z = q.astype(np.float64)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.array([roll, np.arcsin(2 * (w * y - z * x)), yaw], np.float32)


def test_px4_commands_are_those_of_the_emulator(px4):
    module, network, race, own = px4
    assert module.library.stub_interval() == round(own.time_step * 1e6)
    rng = np.random.default_rng(1)
    for _ in range(20):
        state = level_state(rng)
        assert np.all(module.step(state, armed=False)[0] == -1)  # nothing is published
        motors, ready = module.step(state)
        by_place = np.zeros(4, np.float32)
        by_place[PX4_PLACES] = state[13:]
        row = np.concatenate([state[:6], euler(state[6:10]), state[10:13], by_place])
        wanted = expected_commands(network, race, row[None].astype("f4"), np.zeros(1, int))[0]
        assert ready and np.all((motors >= 0) & (motors <= 1))
        np.testing.assert_allclose(motors, wanted[PX4_PLACES], atol=2e-6)  # angles of another libm
        assert len(set(motors.tolist())) == 4


def test_px4_holds_then_idles_when_something_is_lost(px4):
    module, *_ = px4
    state = level_state(np.random.default_rng(2))
    for lost in (1, 2, 4):
        module.step(state, armed=False)
        flown, ready = module.step(state)
        assert ready
        held, ready = module.step(state, lost=lost)
        assert not ready
        np.testing.assert_array_equal(held, flown)
        for _ in range(12):
            idle, ready = module.step(state, lost=lost)
        assert not ready and np.array_equal(idle, np.zeros(4))
        again, ready = module.step(state)
        assert ready and np.all(again > 0)


def test_px4_takes_numbers_of_any_bits(px4):
    module, *_ = px4
    rng = np.random.default_rng(3)
    states = rng.integers(0, 2**32, (2000, 17), dtype=np.uint32).view(np.float32)
    states[:, 13:] = rng.uniform(-1e8, 1e8, (2000, 4))  # what an int32 of rpm can be
    motors = np.stack([module.step(state)[0] for state in states])
    assert np.all((motors >= 0) & (motors <= 1))


@pytest.mark.slow
def test_px4_refuses_bad_files_and_airframes(px4, tmp_path):
    _, network, race, own = px4
    data = converted(*made("published racing"))[2]
    changed = bytearray(data)
    changed[3000] ^= 1
    for number, (content, geometry) in enumerate([(bytes(changed), 0), (b"", 0), (data, 1)]):
        library = px4_library(network, race, content, tmp_path / str(number))
        assert library.stub_start(geometry) == 1  # it asks for no mode


def crazyflie_library(policy, own, folder):
    network, race, data = converted(policy, own)
    write(emit_crazyflie("made", data, network, race, own.time_step), folder)
    source = folder / CRAZYFLIE_FOLDER / "src"
    flags = [f"-I{source}", f"-I{STUBS / 'crazyflie_stubs'}", "-DQJP_STATIC=1"]
    files = [*source.glob("*.c"), STUBS / "crazyflie_stubs/stub_main.c"]
    return load_library(host(), files, folder / "cf.so", [*flags, *CRAZYFLIE_FLAGS, "-lm"]), flags


CRAZYFLIE_FLAGS = (
    "-std=gnu11 -Wall -Wextra -Werror -Wmissing-braces -fno-strict-aliasing -Wdouble-promotion "
    "-Wno-missing-field-initializers -fno-math-errno"
).split()


@pytest.fixture(scope="module")
def crazyflie(tmp_path_factory):
    policy, own = without_rotors()
    folder = tmp_path_factory.mktemp("crazyflie")
    library, flags = crazyflie_library(policy, own, folder)
    library.controllerOutOfTreeInit()
    library.controllerOutOfTreeTest.restype = ctypes.c_bool
    assert library.controllerOutOfTreeTest()
    return library, flags, folder, policy, own


def crazyflie_step(library, state, enabled=True, step=0):
    """Motors (4,) of the controller, of a state in the firmware's axes."""
    state, motors = np.ascontiguousarray(state, np.float32), np.zeros(4, np.float32)
    library.stub_step(pointer(state), enabled, step, pointer(motors))
    return motors


FLIP = np.array([1, -1, -1], np.float32)  # forward-left-up to forward-right-down


def test_crazyflie_commands_are_those_of_the_emulator(crazyflie):
    library, _, _, policy, own = crazyflie
    network, race, _ = converted(policy, own)
    rng = np.random.default_rng(4)
    last = (policy.command_low + policy.command_high).astype(np.float32) / 2
    assert np.array_equal(crazyflie_step(library, np.zeros(13), enabled=False), np.zeros(4))
    for step in range(0, 50, 10):
        state = level_state(rng)[:13]
        theirs = state.copy()
        theirs[:3], theirs[3:6], theirs[7:10] = state[:3] * FLIP, state[3:6] * FLIP, 0
        theirs[7:10] = state[7:10] * FLIP
        theirs[10:13] = np.rad2deg(state[10:13] * FLIP)
        motors = crazyflie_step(library, theirs, step=step)
        held = crazyflie_step(library, np.zeros(13), step=step + 1)
        np.testing.assert_array_equal(held, motors)  # between two steps of the policy
        row = np.concatenate([state[:6], euler(state[6:10]), state[10:13], np.zeros(4), last])
        last = expected_commands(network, race, row[None].astype("f4"), np.zeros(1, int))[0]
        np.testing.assert_allclose(motors, last[CRAZYFLIE_PLACES], atol=5e-6)
        assert len(set(motors.tolist())) == 4
    bits = rng.integers(0, 2**32, (1000, 13), dtype=np.uint32).view(np.float32)
    motors = np.stack([crazyflie_step(library, row) for row in bits])
    assert np.all((motors >= 0) & (motors <= 1))


def test_crazyflie_compiles_for_its_processor(crazyflie):
    _, flags, folder, *_ = crazyflie
    try:
        compiler = arm_none_eabi("Cortex-M4")
    except Skipped as reason:
        pytest.skip(str(reason))
    for source in (folder / CRAZYFLIE_FOLDER / "src").glob("*.c"):
        compiler.build([source], folder / "m4.o", [*flags, *CRAZYFLIE_FLAGS, "-c"])


def test_policies_that_an_autopilot_cannot_fly_are_refused():
    policy, own = made("published racing")
    network, race, _ = converted(policy, own)
    with pytest.raises(InputError, match="crazyflie: the policy observes rotor_speed, which a Cra"):
        check_crazyflie(network, race, 0.01)
    policy, own = without_rotors()
    with pytest.raises(InputError, match="time step is 0.0105 s, allowed: whole milliseconds"):
        check_crazyflie(*converted(policy, own)[:2], 0.0105)
    with pytest.raises(InputError, match="--target px4: .*'motor', allowed: racing, a2rl"):
        check_motor_policy("px4", named_network("motor 64")[1], None)


def quaternion_of(angles):
    """w, x, y, z of roll, pitch and yaw."""
    (cr, cp, cy), (sr, sp, sy) = (f(angles.astype(np.float64) / 2) for f in (np.cos, np.sin))
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def by_place(motors, places):
    found = np.zeros(4, np.float32)
    found[places] = motors
    return found


def flown(policy, own, reset, control, runs=6, lap_count=2):
    """The same starts in the simulator with the emulator, and with ``control``, one by one.

    ``control`` takes position, velocity, Euler angles, rates and rotor speeds by place of one
    drone, and gives its motor commands by place.
    """
    network = convert(policy, track_ranges(policy.layout, own.params.track) | {"position": 32.0})
    choices, params = checks_indiflight._exact(own)
    actor, pilot = fixed_point_fly(policy, network.box.declared), own.pilot
    world, advance = checks_indiflight._world(own), checks_indiflight._advance(own)
    steps, results = laps.step_limit(params, lap_count), []
    for run in range(runs):
        key = jax.random.key(run)
        start = laps.starting_states(choices, params, key, 1, from_hover=run == 0)
        start = start.replace(target=jnp.zeros_like(start.target))
        arguments = (choices, actor, lap_count, steps, False, params, pilot, start, key)
        reference, _ = laps.fly_race(*arguments)
        race, taken = laps.begin(start, lap_count), 0
        reset()
        while taken < steps and not np.asarray(race.over).all():
            row = np.array(world(race.state))[0]
            rotors = row[12:][list(checks_indiflight.MOTORS)]
            command = control(np.concatenate([row[:12], rotors]), taken)[None]
            scaled = 2.0 * (command - pilot.low) / (pilot.high - pilot.low) - 1.0
            race, taken = advance(race, jnp.asarray(scaled, jnp.float32)), taken + 1
        limit = laps.time_limit(params.track, lap_count)
        results.append(
            [laps.laps_of(own.choices, x, own.time_step, limit) for x in (reference, race)]
        )
    return results


def assert_same_ends(results, time_step):
    for reference, found in results:
        assert reference.crashes == found.crashes
        for name in ("lap_times", "seconds"):
            pair = (getattr(found, name), getattr(reference, name))
            np.testing.assert_allclose(*pair, atol=1.001 * time_step)


@pytest.mark.slow
def test_px4_flies_races_as_the_emulator(px4):
    module, *_ = px4
    policy, own = made("published racing")

    def control(row, _step):
        rotors = row[12:][PX4_PLACES]
        state = np.concatenate([row[:6], quaternion_of(row[6:9]), row[9:12], rotors])
        return by_place(module.step(state)[0], PX4_PLACES)

    rest = np.zeros(17) + np.eye(17)[6]
    assert_same_ends(flown(policy, own, lambda: module.step(rest, armed=False), control), 0.01)


@pytest.mark.slow
def test_crazyflie_flies_races_as_the_emulator(crazyflie):
    library, _, _, policy, own = crazyflie

    def control(row, step):
        q = quaternion_of(row[6:9]) * np.append(1.0, FLIP)
        parts = [row[:3] * FLIP, row[3:6] * FLIP, q, np.rad2deg(row[9:12] * FLIP)]
        return by_place(
            crazyflie_step(library, np.concatenate(parts), True, 10 * step), CRAZYFLIE_PLACES
        )

    def reset():
        crazyflie_step(library, np.zeros(13), enabled=False)

    assert_same_ends(flown(policy, own, reset, control), 0.01)
