"""The C runtime, whatever the policy: warnings, self-tests, and words that are changed."""

import functools
import shutil
import subprocess

import numpy as np
import pytest

from benchmarks import eva, mutate
from benchmarks.instructions_boards import Board, vehicles
from benchmarks.instructions_builds import BUILDS, arm_none_eabi, bebop, zig_thumb
from quadjax.core.errors import InputError
from quadjax.export import emulator
from quadjax.export.cases import check_vectors, hostile_vectors
from quadjax.export.integers import quantize
from quadjax.export.read import unpack
from quadjax.export.targets import RUNTIME, TARGETS
from quadjax.export.verify.build import Sources
from quadjax.export.verify.result import Skipped
from quadjax.export.verify.toolchain import WARNINGS, host
from quadjax.export.words import layout_header, pack
from tests.export.support import fixed
from tests.export.words import FILES, at_of, edited, load, runtime_of, with_flipped_weight

LARGEST_STACK = 3072  # bytes
CLAMPED = 4  # instructions that depend on whether a command is clamped


def need(program):
    """Skip unless a program is on the path."""
    if shutil.which(program) is None:
        pytest.skip(f"no {program} on this machine")
    return program


def test_the_words_of_the_c_are_those_of_the_table():
    assert (RUNTIME / "qj_words.h").read_text() == layout_header()


@pytest.mark.slow
def test_no_compiler_warns(tmp_path):
    makers = [host, bebop, *(functools.partial(f, "cortex-m4") for f in (arm_none_eabi, zig_thumb))]
    for make in makers:
        try:
            compiler = make()
        except Skipped:
            continue
        for source in FILES:
            extra = [*WARNINGS, "-O3", f"-I{RUNTIME}", "-c"]
            compiler.build([source], tmp_path / "warnings.o", extra)


def test_cppcheck_finds_nothing():
    command = [need("cppcheck"), "--enable=warning,performance,portability", "--error-exitcode=1"]
    command += ["--std=c99", "--quiet", f"-I{RUNTIME}", *map(str, FILES)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr.strip(), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("processor", BUILDS)
@pytest.mark.parametrize("hidden", [(33, 7, 18), ()])  # that no block divides, and no hidden layer
def test_every_kernel_has_the_bits_of_numpy_on_board(hidden, processor, tmp_path):
    """And its instructions and stack do not depend on the numbers."""
    policy = fixed("e2e", hidden)
    network, (states, targets) = policy.network, states_of_any_bits(policy)
    x = np.concatenate([check_vectors(network, 400, None), hostile_vectors(network)])
    q = quantize(x, network.box.exponents).astype(np.int32)
    seen, status = emulator.observe(policy.race, states, targets)
    sources, missing = Sources.write(TARGETS[processor], None, tmp_path, policy), []
    for build in BUILDS[processor]:
        try:
            board = Board(sources, build, pack(policy), tmp_path)
        except Skipped as reason:
            missing.append(str(reason))
            continue
        rows = board.rows("forward", 5, len(q), q)
        np.testing.assert_array_equal(rows, emulator.forward_rows(network, q))
        goals = targets.astype(np.uint32)
        rows = board.rows("observe", network.inputs + 3, len(states), states, goals)
        np.testing.assert_array_equal(rows, np.concatenate([seen, status.view(np.int32)], axis=1))
        counts, stacks = zip(*(board.count("infer", row) for row in x[::40]), strict=True)
        assert max(counts) - min(counts) <= CLAMPED * network.outputs, build.label
        steps = (board.count("step", row) for row in vehicles(policy, states[::40])[:, None])
        assert max(*stacks, *(stack for _, stack in steps)) < LARGEST_STACK
    if missing:
        pytest.skip("; ".join(missing))


def states_of_any_bits(policy):
    """States (n, state_size) float32, half of them of any bits, and target gates (n,)."""
    rng, race, count = np.random.default_rng(6), policy.race, 400
    ranges = np.ldexp(1.0, np.asarray(race.exponents))
    states = (rng.uniform(-1.2, 1.2, (count, race.state_size)) * ranges).astype(np.float32)
    bits = rng.integers(0, 2**32, (count // 2, race.state_size), dtype=np.uint32)
    states[: count // 2] = bits.view(np.float32)
    return states, rng.integers(0, race.gates, count)


CHANGES = {  # of the C: file, what stands there, what stands there then
    "shift of 31": ("qj_network.c", ">sums[row] >> WORD", ">sums[row] >> 31"),
    "no ReLU": ("qj_network.c", "(upper > 0) ? upper : 0", "upper"),
    "output shift": ("qj_network.c", "(int32_t)(sum >> ", "(int32_t)(sum >> 1 + "),
    "NaN not seen": (
        "qj_integers.h",
        "*nan = (magnitude > UINT32_C(0x7F800000)) ? 1U : 0U",
        "*nan = 0U",
    ),
    "late clipping": ("qj_integers.h", "? limit : magnitude;", "? magnitude : magnitude;"),
    "left for right": ("qj_race.c", "cosine * v[1] - sine", "cosine * v[1] + sine"),
    "no rounding": ("qj_integers.h", "(value + (INT64_C(1) << (shift - 1)))", "value"),
    "half a gain": ("qj_estimator.c", "qj_scaled(2 * x, gain", "qj_scaled(x, gain"),
    "no residual": ("qj_estimator.c", "x[i] -= qj_clamp", "x[i] -= 0 * qj_clamp"),
    "a square": ("qj_estimator.c", "square[0] - square[1]", "square[0] + square[1]"),
    "no feedback": ("qj_estimator.c", "qj_scaled(y, qj_long(e + QJ_ESTIMATOR_A2), Q30)", "0"),
    "another start": ("qj_estimator.c", "= -qj_scaled(d[i]", "= qj_scaled(d[i]"),
    "above the limit": ("qj_estimator.c", "(command >= limit) ? ONE : 0", "ONE"),
    "no limit": ("qj_estimator.c", "(command >= limit) ? limit : command", "command"),
    "no lead": ("qj_estimator.c", "b[QJ_BATTERY_LEAD], ", "0, "),
    "half a battery's gain": (
        "qj_estimator.c",
        "b[QJ_BATTERY_GAIN], ",
        "b[QJ_BATTERY_GAIN] / 2, ",
    ),
    "one motor": ("qj_estimator.c", "sum += qj_scaled(error", "sum = qj_scaled(error"),
    "below the lowest": ("qj_estimator.c", "qj_long(b + QJ_BATTERY_LOWEST), qj", "0, qj"),
    "another first one": ("qj_estimator.c", "QJ_BATTERY_FIRST", "QJ_BATTERY_HIGHEST"),
}


@pytest.mark.slow
def test_the_self_tests_see_a_change_of_the_c(tmp_path):
    words = pack(fixed("everything"))
    assert load(runtime_of(tmp_path / "right"), words) == 0
    for name, change in CHANGES.items():
        assert load(runtime_of(tmp_path / name, change), words) == 13, name


@pytest.fixture(scope="module")
def runtime(tmp_path_factory):
    return runtime_of(tmp_path_factory.mktemp("runtime") / "c")


@pytest.fixture(scope="module")
def data():
    return pack(fixed("published racing"))


EDITS = {  # what is changed: part, field, row, value, error of the loader
    "magic": ("header", "magic", 0, 1, 2),
    "version": ("header", "version", 0, 5, 3),
    "size": ("header", "bytes", 0, 400, 1),
    "inputs": ("header", "inputs", 0, 4000, 5),
    "layers": ("header", "layers", 0, 17, 5),
    "no gates": ("header", "gates", 0, 0, 6),
    "more gates": ("header", "gates", 0, 4000, 1),
    "shift": ("header", "output_shift", 0, 33, 6),
    "fraction": ("header", "fraction_bits", 0, 31, 6),
    "no time step": ("header", "period_ns", 0, 0, 6),
    "low above high": ("header", "low", 0, 2**31 - 1, 6),
    "rows": ("layer", "rows", 0, 500, 5),
    "columns": ("layer", "columns", 0, 21, 6),
    "an unknown field": ("field", "code", 0, 13, 7),
    "a field of five": ("field", "size", 0, 5, 7),
    "a range of 2^40": ("exponents", None, 0, 40, 7),
    "an unknown input": ("part", "kind", 0, 8, 8),
    "an input elsewhere": ("part", "index", 0, 1, 8),
    "a source beyond the state": ("input", "source", 0, 99, 8),
    "a shift of 61": ("input", "shift", 12, 61, 8),
    "a scale that is not used": ("input", "middle", 0, 1, 8),
    "a cosine above 1": ("gate", "cosine", 0, 2**30 + 1, 9),
    "a negative width": ("gate", "half_width", 0, -1, 9),
    "a gate elsewhere": ("gate", "position", 0, 12345, 13),
    "padding of weights": ("weights", None, 4 * 20, 1, 10),
}


def test_what_a_new_checksum_does_not_hide(data, runtime):
    assert load(runtime, data) == 0 and pack(unpack(data)) == data
    for name, (part, field, row, value, error) in EDITS.items():
        changed = edited(data, {at_of(data, part, field, row): value})
        assert load(runtime, changed) == error, name
        with pytest.raises(InputError):
            unpack(changed)


def test_every_flipped_bit_is_refused(data, runtime):
    rng = np.random.default_rng(1)
    for _ in range(300):
        changed = bytearray(data)
        changed[rng.integers(len(data))] ^= 1 << rng.integers(8)
        assert load(runtime, bytes(changed)) != 0
    with pytest.raises(InputError, match="changed since it was written|not a .qjp|bytes"):
        unpack(bytes(changed))
    for size in (4, 200, len(data) - 4):
        assert load(runtime, data[: size // 4 * 4]) == 1


def with_largest_weights(data):
    """Words whose first neuron may overflow."""
    start = at_of(data, "weights")
    return edited(data, {start + 4 * column: 2**31 - 1 for column in range(20)})


def test_weights_that_may_overflow_are_refused(data, runtime):
    assert load(runtime, with_largest_weights(data)) == 11
    with pytest.raises(InputError, match="layer 0, row 0: .* allowed"):
        unpack(with_largest_weights(data))
    assert load(runtime, with_flipped_weight(data)) == 13


@pytest.mark.slow
def test_mutated_files_under_sanitizers(tmp_path):
    need("gcc")
    files = []
    for name in ("published racing", "everything", "racing, axes and more"):
        files.append(tmp_path / f"{name}.qjp")
        files[-1].write_bytes(pack(fixed(name)))
    assert mutate.fuzz(files, 4500, 450, 0, mutate.build(tmp_path)) == []


@pytest.mark.slow
def test_frama_c_has_no_alarm(tmp_path):
    need("frama-c")
    words = pack(fixed("racing, axes and more"))
    assert eva.analyze(words, tmp_path / "right")[:2] == (0, True)
    assert eva.analyze(with_largest_weights(words), tmp_path / "wrong")[0] > 0
