"""The C runtime, whatever the policy: warnings, bits, self-tests, mutated words."""

import ctypes
import functools
import shutil
import subprocess
import zlib

import numpy as np
import pytest

from benchmarks import eva, mutate
from quadjax.core.errors import InputError
from quadjax.export import emulator
from quadjax.export.cases import check_vectors, hostile_vectors
from quadjax.export.disturbances import make_estimator
from quadjax.export.integers import quantize
from quadjax.export.read import unpack
from quadjax.export.targets import RUNTIME, TARGETS
from quadjax.export.verify.build import BUILDS, OnBoard, Sources, load_library
from quadjax.export.verify.result import Skipped
from quadjax.export.verify.toolchain import WARNINGS, arm_none_eabi, bebop, host, zig_thumb
from quadjax.export.words import STRUCTS, layout_header, pack
from tests.export.support import (
    POLICIES,
    fixed,
    fixed_policy,
    library,
    made_policy,
    made_residual,
    need,
)
from tests.export.support import made as layout
from tests.export.test_race_export import own_race

FILES = sorted(path for path in RUNTIME.glob("qj_*.c") if path.name != "qj_angles.c")
SANITIZERS = "-std=c99 -fsanitize=address,undefined -fno-sanitize-recover=all -g -O1".split()


@functools.cache
def network(name):
    """The words of one of ``POLICIES`` in its race, and the policy as integers."""
    policy = made_policy(**POLICIES[name])
    made = fixed_policy(policy, own_race(policy))
    return made, pack(made)


def test_the_words_of_the_c_are_those_of_the_table():
    assert (RUNTIME / "qj_words.h").read_text() == layout_header()


def test_no_compiler_warns(tmp_path):
    makers = [host, bebop, *(functools.partial(f, "Cortex-M4") for f in (arm_none_eabi, zig_thumb))]
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


FEW = ["odd", "linear"]  # sizes that no block divides, and no hidden layer
SLOW = [pytest.param(n, marks=pytest.mark.slow) for n in POLICIES if n not in (*FEW, "wide")]


@pytest.mark.parametrize("name", [*FEW, *SLOW])
def test_the_c_has_the_bits_of_numpy(name, tmp_path):
    made, _ = network(name)
    x = np.concatenate([check_vectors(made.network, 800, None), hostile_vectors(made.network)])
    q = quantize(x, made.network.box.exponents).astype(np.int32)
    q = np.concatenate([q, np.random.default_rng(0).integers(-(2**31), 2**31, q[:50].shape)])
    rows = library(made, tmp_path).forward(q)
    np.testing.assert_array_equal(rows, emulator.forward_rows(made.network, q))


@pytest.mark.slow
@pytest.mark.parametrize("processor", BUILDS)
@pytest.mark.parametrize("name", ["odd", "linear"])
def test_every_kernel_passes_the_self_tests_on_board(name, processor, tmp_path):
    made, words = network(name)
    target = next(t for t in TARGETS.values() if t.processor == processor)
    sources = Sources.write(target, None, tmp_path, made)
    missing = []
    for build in BUILDS[processor]:
        try:
            assert OnBoard(sources, build, words, tmp_path).pilot
        except Skipped as reason:
            missing.append(str(reason))
    if missing:
        pytest.skip("; ".join(missing))


# ---- changes of the C ----------------------------------------------------------------------------

CHANGES = {
    "shift of 31": ("qj_network.c", ">sums[row] >> WORD", ">sums[row] >> 31"),
    "no ReLU": ("qj_network.c", "(upper > 0) ? upper : 0", "upper"),
    "output shift": ("qj_network.c", "(int32_t)(sum >> ", "(int32_t)(sum >> 1 + "),
    "NaN not seen": (
        "qj_integers.h",
        "*nan = (magnitude > UINT32_C(0x7F800000)) ? 1U : 0U",
        "*nan = 0U",
    ),
    "late clipping": ("qj_integers.h", "? limit : magnitude;", "? magnitude : magnitude;"),
    "another lag": ("qj_race.c", "policy->history - lag", "policy->history - 1U"),
    "no first state": ("qj_race.c", "race->filled == 0U", "race->filled == 2U"),
    "a state of one number": ("qj_race.c", "row[i] = s[i]", "row[i] = s[0]"),
    "left for right": ("qj_race.c", "cosine * v[1] - sine", "cosine * v[1] + sine"),
    "no rounding": ("qj_integers.h", "(value + (INT64_C(1) << (shift - 1)))", "value"),
    "half a gain": ("qj_estimator.c", "qj_scaled(2 * x, gain", "qj_scaled(x, gain"),
    "no residual": ("qj_estimator.c", "x[i] -= qj_clamp", "x[i] -= 0 * qj_clamp"),
    "a square": ("qj_estimator.c", "square[0] - square[1]", "square[0] + square[1]"),
    "no feedback": ("qj_estimator.c", "qj_scaled(y, qj_long(e + QJ_ESTIMATOR_A2), Q30)", "0"),
    "another start": ("qj_estimator.c", "= -qj_scaled(d[i]", "= qj_scaled(d[i]"),
}
BATTERY_CHANGES = {
    "above the limit": ("qj_estimator.c", "(command >= limit) ? ONE : 0", "ONE"),
    "no limit": ("qj_estimator.c", "(command >= limit) ? limit : command", "command"),
    "no lead": ("qj_estimator.c", "b[QJ_BATTERY_LEAD], ", "0, "),
    "half a gain": ("qj_estimator.c", "b[QJ_BATTERY_GAIN], ", "b[QJ_BATTERY_GAIN] / 2, "),
    "one motor": ("qj_estimator.c", "sum += qj_scaled(error", "sum = qj_scaled(error"),
    "below the lowest": ("qj_estimator.c", "qj_long(b + QJ_BATTERY_LOWEST), qj", "0, qj"),
    "another first one": ("qj_estimator.c", "QJ_BATTERY_FIRST", "QJ_BATTERY_HIGHEST"),
}


@functools.cache
def everything():
    """A policy with a history and an estimator with a residual, and its words."""
    policy, own = layout("e2e with a history")
    residual = made_residual(np.random.default_rng(0))
    tables = make_estimator(own.params.vehicle.constants, residual)
    made = fixed_policy(policy, own, estimator=tables)
    return made, pack(made)


def runtime_of(folder, change=None, *options):
    """A copy of the runtime as a library, perhaps changed."""
    folder.mkdir()
    for path in RUNTIME.glob("qj*.[ch]"):
        shutil.copy(path, folder)
    if change:
        file, old, new = change
        text = (folder / file).read_text()
        assert old in text, old
        (folder / file).write_text(text.replace(old, new, 1))
    files = [folder / path.name for path in FILES]
    return load_library(host(), files, folder / "runtime.so", [f"-I{folder}", *options])


def load(runtime, data):
    """The error of ``qj_load``."""
    words = np.frombuffer(data, np.int32).copy()
    memory = [np.zeros(size, np.uint8) for size in (4096, 2**18)]
    pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (*memory, words)]
    return runtime.qj_load(*pointers, len(data))


@pytest.mark.slow
def test_the_self_tests_see_a_change_of_the_c(tmp_path):
    right, kinds = runtime_of(tmp_path / "right"), {"disturbances": CHANGES, "rpm": BATTERY_CHANGES}
    words = {"disturbances": everything()[1], "rpm": pack(fixed("e2e, axes and more")[1])}
    for kind, changes in kinds.items():
        assert load(right, words[kind]) == 0
        for name, change in changes.items():
            assert load(runtime_of(tmp_path / f"{kind} {name}", change), words[kind]) == 13, name


# ---- changes of the words ------------------------------------------------------------------------


@pytest.fixture(scope="module")
def runtime(tmp_path_factory):
    return runtime_of(tmp_path_factory.mktemp("runtime") / "c")


@pytest.fixture(scope="module")
def data():
    return pack(fixed("published racing")[1])


def edited(data, changes):
    """The words with other numbers, and the checksum of what they then are."""
    words = np.frombuffer(data, "<i4").copy()
    for at, value in changes.items():
        words[at] = value
    body = words.tobytes()[:-4]
    return body + zlib.crc32(body).to_bytes(4, "little")


def header_of(data):
    """Numbers of the header by name."""
    header = np.frombuffer(data, STRUCTS["header"], 1)[0]
    return {name: int(header[name]) for name in header.dtype.names if header[name].ndim == 0}


def at_of(data, part, field=None, row=0):
    """The place of a word: of a structure's field, or of a part's first word."""
    size = {name: struct.itemsize // 4 for name, struct in STRUCTS.items()}
    header = header_of(data)
    parts = {"header": size["header"], "layer": size["layer"] * header["layers"]}
    parts |= {"field": size["field"] * header["fields"], "exponents": header["state_size"]}
    parts |= {"part": size["part"] * header["parts"], "input": size["input"] * header["inputs"]}
    parts |= {"gate": (size["gate"] + header["constants"]) * header["gates"], "weights": 0}
    start = sum(list(parts.values())[: list(parts).index(part)])
    place = STRUCTS[part].fields[field][1] // 4 + row * size[part] if field else row
    return start + place


EDITS = {  # what is changed: part, field, row, value, error of the loader
    "magic": ("header", "magic", 0, 1, 2),
    "version": ("header", "version", 0, 3, 3),
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
    "a lag of 5000": ("part", "lag", 0, 5000, 8),
    "a source beyond the state": ("input", "source", 0, 99, 8),
    "a shift of 61": ("input", "shift", 12, 61, 8),
    "a scale that is not used": ("input", "middle", 0, 1, 8),
    "a cosine above 1": ("gate", "cosine", 0, 2**30 + 1, 9),
    "a negative width": ("gate", "half_width", 0, -1, 9),
    "a gate elsewhere": ("gate", "position", 0, 12345, 13),
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


def test_weights_that_may_overflow_are_refused(data, runtime):
    start = at_of(data, "weights")
    largest = {start + 4 * column: 2**31 - 1 for column in range(20)}
    assert load(runtime, edited(data, largest)) == 11
    with pytest.raises(InputError, match="layer 0, row 0: .* allowed"):
        unpack(edited(data, largest))
    assert load(runtime, edited(data, {start + 4 * 20: 1})) == 10  # of the padding
    flipped = {start: int(np.frombuffer(data, "<i4")[start]) ^ 1}
    assert load(runtime, edited(data, flipped)) == 13


def files_of(folder, *kinds):
    """Files of words."""
    words = {"racing": pack(fixed("published racing")[1]), "everything": everything()[1],
             "history": pack(fixed("racing with a history")[1]),
             "battery": pack(fixed("e2e, axes and more")[1])}  # fmt: skip
    for kind in kinds:
        (folder / f"{kind}.qjp").write_bytes(words[kind])
    return [folder / f"{kind}.qjp" for kind in kinds]


@pytest.mark.slow
@pytest.mark.parametrize("kinds", [("racing",), ("everything", "history", "battery")])
def test_mutated_files_under_sanitizers(kinds, tmp_path):
    need("gcc")
    files, program = files_of(tmp_path, *kinds), mutate.build(tmp_path)
    assert mutate.mutate(files, 3000, 300, 0, program) == []


@pytest.mark.slow
def test_frama_c_has_no_alarm(tmp_path):
    need("frama-c")
    (path,) = files_of(tmp_path, "history")
    words = path.read_bytes()
    assert eva.analyze(words, tmp_path / "right")[:2] == (0, True)
    start = at_of(words, "weights")
    largest = {start + 4 * column: 2**31 - 1 for column in range(67)}
    assert eva.analyze(edited(words, largest), tmp_path / "wrong")[0] > 0
