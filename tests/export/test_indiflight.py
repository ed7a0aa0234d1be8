"""INDIflight's files: what they contain, and nn_control compiled on this machine."""

import ctypes
import functools

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.export.convert import export_c
from quadjax.export.emit import emit_network, emit_race
from quadjax.export.fixed import convert
from quadjax.export.indiflight import MOTORS, check_indiflight, emit_indiflight
from quadjax.export.race_tables import make_tables, track_ranges
from quadjax.export.verify import checks_indiflight, run
from quadjax.export.verify.checks_indiflight import WARNINGS, hostile_states
from quadjax.export.verify.context import Context
from quadjax.export.verify.folder import read_folder
from quadjax.export.verify.harness import load_library
from quadjax.export.verify.result import PASSED, SKIPPED, Failed, run_check
from quadjax.export.verify.toolchain import host
from tests.export.support import ORIGIN, named_network, need, random_states
from tests.export.test_layouts import made


def emit(name):
    """The files, by path, of an untrained policy in a race of the 5-inch drone, and the race."""
    policy, own = made(name)
    network = convert(policy, track_ranges(policy.layout, own.params.track) | {"position": 32.0})
    tables = make_tables(network.box, policy, own.choices, own.params)
    rng = np.random.default_rng(0)
    states = random_states(rng, 20, own, policy.command_low, policy.command_high)
    files = emit_network(network, ORIGIN, None)
    files |= emit_race(tables, network, ORIGIN, states, rng.integers(0, tables.gates, 20))
    return files | emit_indiflight(files, network, ORIGIN, tables, own, policy), own


@pytest.fixture(scope="module")
def emitted():
    return emit("published racing")


def write(files, folder):
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)


def build(files, folder):
    write(files, folder)
    sources = [folder / "indiflight" / name for name in ("neural_network.c", "nn_controller.c")]
    own = [folder / "made.c", folder / "made_race.c"]
    return (
        load_library(host(), sources, folder / "nn.so", WARNINGS),
        load_library(host(), own, folder / "own.so"),
    )


class Counters(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_uint32) for name in ("steps", "nan", "clipped", "outside", "a", "b")
    ]


def control(library, state):
    state, out = np.ascontiguousarray(state, np.float32), np.full(4, np.nan, np.float32)
    library.nn_control(*(a.ctypes.data_as(ctypes.c_void_p) for a in (state, out)))
    return out


def test_motors_are_in_the_order_of_indiflight():
    ours = ["front left", "front right", "rear right", "rear left"]
    theirs = ["rear right", "front right", "rear left", "front left"]
    assert [theirs.index(motor) for motor in ours] == list(MOTORS)


def test_commands_are_those_of_the_exported_race_and_in_range(emitted, tmp_path):
    files, own = emitted
    library, reference = build(files, tmp_path)
    assert library.nn_self_test() == 0
    library.nn_reset()
    gates = np.asarray((ctypes.c_float * 3 * len(own.params.track.yaw)).in_dll(library, "gate_pos"))
    positions = [np.asarray(x) for x in own.params.track.position.components()]
    np.testing.assert_array_equal(gates, np.stack(positions, axis=1))
    rng = np.random.default_rng(1)
    state = rng.uniform(-1, 1, 16).astype(np.float32) + np.float32([0] * 12 + [900] * 4)
    ordered = np.concatenate([state[:12], state[12:][list(MOTORS)]])
    race, wanted = (ctypes.c_uint32 * 16)(), np.zeros(4, np.float32)
    place = [a.ctypes.data_as(ctypes.c_void_p) for a in (ordered, wanted)]
    reference.made_race_start(race, place[0], 0)
    step = reference.made_race_step
    step.restype = type("Status", (ctypes.Structure,), {"_fields_": [("x", ctypes.c_uint32 * 3)]})
    status = step(race, 0, place[0], place[1], None)
    assert list(status.x) == [0, 0, 0]
    np.testing.assert_array_equal(control(library, state)[list(MOTORS)], wanted)
    assert len(set(wanted.tolist())) == 4
    commands = np.stack([control(library, row) for row in hostile_states(500)])
    assert np.all((commands >= 0) & (commands <= 1))
    library.nn_counters.restype = Counters
    counters = library.nn_counters()
    assert counters.steps == 501 and 0 < counters.nan < 501 and 0 < counters.clipped < 501


@pytest.mark.parametrize(
    "name", ["racing, axes and more", pytest.param("racing with a history", marks=pytest.mark.slow)]
)
def test_a_policy_of_earlier_steps_runs_at_the_rate_of_its_training(name, tmp_path):
    files, own = emit(name)
    write(files, tmp_path)
    folder = tmp_path / "indiflight"
    sources = [folder / "neural_network.c", folder / "nn_controller.c"]

    def library(*flags):
        return load_library(host(), sources, tmp_path / f"{len(flags)}.so", [*flags, "-lm"])

    assert own.time_step == pytest.approx(0.01)
    states = np.random.default_rng(2).uniform(-1, 1, (40, 16)).astype(np.float32)
    states[:, 12:] += 900
    often, seldom = library(), library("-DNN_CONTROL_HZ=100")  # 500 Hz is the firmware's rate
    fast = np.stack([control(often, row) for row in states])
    slow = np.stack([control(seldom, row) for row in states[::5]])
    np.testing.assert_array_equal(fast, np.repeat(slow, 5, axis=0))
    assert len(np.unique(slow, axis=0)) == len(slow)
    often.nn_counters.restype = Counters
    assert often.nn_counters().steps == len(slow)
    with pytest.raises(Failed, match="NN_CONTROL_HZ: no whole number of calls is a step"):
        library("-DNN_CONTROL_HZ=130", "-DNDEBUG")


@pytest.mark.slow
def test_the_proof_covers_any_history(tmp_path):
    need("frama-c")
    policy, _ = made("racing with a history")
    policy.save(tmp_path / "policy.npz")
    ranges = {"position": 64.0, "velocity": 128.0, "rates": 1024.0}
    options = {"allow_unfinished": True, "target": "indiflight"}
    export_c(tmp_path / "policy.npz", tmp_path / "c", ranges=ranges, name="made", **options)
    (tmp_path / "work").mkdir()
    context = Context(read_folder(tmp_path / "c"), tmp_path / "work", 200, 8, True, True)
    assert "0 alarms" in checks_indiflight.check_eva(context)
    source = tmp_path / "c" / "indiflight" / "nn_controller.c"
    text = source.read_text()
    bound = "(history->next < MADE_HISTORY) ? history->next : 0U"
    assert bound in text
    source.write_text(text.replace(bound, "history->next"))
    with pytest.raises(Failed, match="alarms"):
        checks_indiflight.check_eva(context)


def test_a_changed_weight_switches_the_motors_off(emitted, tmp_path):
    files = dict(emitted[0])
    path = "indiflight/neural_network.c"
    start = files[path].index("{", files[path].index("weight_1[")) + 1
    number = files[path][start:].split(",")[0]
    changed = str(int(number) ^ 4)
    files[path] = files[path][:start] + changed + files[path][start + len(number) :]
    library, _ = build(files, tmp_path)
    assert list(control(library, np.zeros(16))) == [0, 0, 0, 0]
    assert library.nn_self_test() > 0


def test_a_policy_without_motor_commands_is_refused():
    with pytest.raises(InputError, match="--target indiflight: .*'motor', allowed: racing, a2rl"):
        check_indiflight(named_network("motor 64")[1], None)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["published racing", "racing, axes and more"])
def test_an_exported_folder_passes_the_checks_of_indiflight(name, tmp_path):
    policy, _ = made(name)
    policy.save(tmp_path / "policy.npz")
    wide = {"position": 64.0, "velocity": 128.0, "rates": 1024.0, "attitude": 4.0}
    ranges = {key: value for key, value in wide.items() if key in policy.layout}
    options = {"allow_unfinished": True, "target": "indiflight"}
    export_c(tmp_path / "policy.npz", tmp_path / "c", ranges=ranges, name="made", **options)
    (tmp_path / "work").mkdir()
    context = Context(read_folder(tmp_path / "c"), tmp_path / "work", 200, 8, True, True)
    checks = run.checks_of(context.folder)
    chosen = {key: checks[key] for key in checks if key.startswith("INDIflight")}
    assert len(chosen) == 5
    parts = {key: functools.partial(check, context) for key, check in chosen.items()}
    results = [run_check(key, check) for key, check in parts.items()]
    assert all(result.verdict in (PASSED, SKIPPED) for result in results), results
    assert sum(result.verdict == PASSED for result in results) >= 3
