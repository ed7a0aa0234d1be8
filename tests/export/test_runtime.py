"""The C runtime, whatever the policy: warnings, bits, self-tests, mutated words."""

import ctypes
import functools
import shutil
import subprocess
import zlib

import numpy as np
import pytest

from quadjax.core.errors import InputError
from quadjax.export import emulator
from quadjax.export.cases import check_vectors, hostile_vectors
from quadjax.export.estimator_tables import make_estimator
from quadjax.export.integers import quantize
from quadjax.export.read import unpack
from quadjax.export.targets import RUNTIME, TARGETS
from quadjax.export.verify.build import BUILDS, OnBoard, Sources, load_library
from quadjax.export.verify.result import Skipped
from quadjax.export.verify.toolchain import WARNINGS, arm_none_eabi, bebop, host, zig_thumb
from quadjax.export.words import STRUCTS, layout_header, pack
from tests.export.support import (
    POLICIES,
    fixed_policy,
    library,
    made_policy,
    made_residual,
    need,
)
from tests.export.test_layouts import fixed
from tests.export.test_layouts import made as layout
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
    commands, trace = emulator.forward_traced(made.network, q)
    rows = library(made, tmp_path).forward(q)
    np.testing.assert_array_equal(rows[:, :4], commands)
    np.testing.assert_array_equal(rows[:, 4].view(np.uint32), emulator.trace_digest(trace))


@pytest.mark.slow
@pytest.mark.parametrize("processor", BUILDS)
@pytest.mark.parametrize("name", ["odd", "linear", "mixed"])
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
}


@functools.cache
def everything():
    """A policy with a history and an estimator with a residual, and its words."""
    policy, own = layout("e2e with a history")
    residual = made_residual(np.random.default_rng(0))
    tables = make_estimator(own.params.vehicle.constants, residual)
    made = fixed_policy(policy, own, estimator=tables)
    return made, pack(made)


def runtime_of(folder, change=None):
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
    return load_library(host(), files, folder / "runtime.so", [f"-I{folder}"])


def load(runtime, data):
    """The error of ``qj_load``."""
    words = np.frombuffer(data, np.int32).copy()
    memory = [np.zeros(size, np.uint8) for size in (4096, 2**18)]
    pointers = [x.ctypes.data_as(ctypes.c_void_p) for x in (*memory, words)]
    return runtime.qj_load(*pointers, len(data))


@pytest.mark.slow
def test_the_self_tests_see_a_change_of_the_c(tmp_path):
    _, words = everything()
    assert load(runtime_of(tmp_path / "right"), words) == 0
    for number, (name, change) in enumerate(CHANGES.items()):
        assert load(runtime_of(tmp_path / str(number), change), words) == 13, name


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


FUZZ = """
#include "qj.h"
uint32_t crc32_of_words(const int32_t *words, uint32_t count);
void fuzz(int32_t *words, uint32_t bytes, const uint32_t *edits, uint8_t *errors, uint32_t count);
uint32_t crc32_of_words(const int32_t *words, uint32_t count) {
  uint32_t crc = 0xFFFFFFFFU;
  for (uint32_t i = 0U; i < 4U * count; ++i) {
    crc ^= ((const uint8_t *)words)[i];
    for (int bit = 0; bit < 8; ++bit) { crc = (crc >> 1) ^ (0xEDB88320U & (0U - (crc & 1U))); }
  }
  return ~crc;
}
/* An edit: two places and two values; the errors of the loader with a right checksum. */
void fuzz(int32_t *words, uint32_t bytes, const uint32_t *edits, uint8_t *errors, uint32_t count) {
  static qj_policy policy;
  static qj_race race;
  const uint32_t last = bytes / 4U - 1U;
  for (uint32_t i = 0U; i < count; ++i) {
    const uint32_t *const e = edits + 4U * i;
    const int32_t old[2] = {words[e[0]], words[e[2]]};
    words[e[0]] = (int32_t)e[1];
    words[e[2]] = (int32_t)e[3];
    words[last] = (int32_t)crc32_of_words(words, last);
    errors[i] = (uint8_t)qj_load(&policy, &race, words, bytes);
    words[e[2]] = old[1];
    words[e[0]] = old[0];
  }
}
"""
EDGES = (0, 1, 2, 3, 4, 7, 8, 31, 32, 33, 64, 127, 128, 129, 4096, 65536, 2**30 - 1, 2**30,
         2**30 + 1, 2**31 - 1, 2**31, 3 * 2**30, 2**32 - 1)  # fmt: skip


def edits_of(data, count, seed):
    """Edits (count, 4) uint32 of words, more in the numbers than in tables and texts."""
    rng, words = np.random.default_rng(seed), np.frombuffer(data, "<u4")
    places = [at_of(data, "header", name) for name in ("source", "name", "vehicle")]
    sizes = [8, 8, 4]  # texts, of which Python alone checks the contents
    places += [at_of(data, "part", "name", row) for row in range(header_of(data)["parts"])]
    sizes += [6] * header_of(data)["parts"]
    texts = {place + i for place, size in zip(places, sizes, strict=True) for i in range(size)}
    texts |= {at_of(data, "header", "kind"), at_of(data, "header", "bytes")}
    numbers = np.array([i for i in range(at_of(data, "weights")) if i not in texts])
    rest = np.arange(at_of(data, "weights"), len(words) - 1)
    places = np.where(
        rng.random((count, 2)) < 0.7, rng.choice(numbers, (count, 2)), rng.choice(rest, (count, 2))
    )
    places[: count // 2, 1] = places[: count // 2, 0]
    kinds = rng.integers(0, 4, (count, 2))
    options = (
        words[places] + 1,
        words[places] - 1,
        rng.choice(EDGES, (count, 2)),
        rng.integers(0, 2**32, (count, 2)),
    )
    values = np.choose(kinds, [np.asarray(x, np.uint64) & 0xFFFFFFFF for x in options])
    return np.stack([places[:, 0], values[:, 0], places[:, 1], values[:, 1]], axis=1).astype(
        np.uint32
    )


def fuzzed(data, count, folder, seed=0):
    """Edits, and the errors of the loader under the sanitizers."""
    (folder / "fuzz.c").write_text(FUZZ + """
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
/* Every length up to that of the header, and some beyond, in memory of exactly that length; the
 * checksum is right, and so is the length that the header states, every second time. */
static int lengths(const int32_t *words, uint32_t bytes, uint32_t place) {
  static qj_policy policy;
  static qj_race race;
  int accepted = 0;
  for (uint32_t size = 4U; size < bytes; size += (size < 400U) ? 4U : 404U) {
    for (uint32_t stated = 0U; stated < 2U; ++stated) {
      int32_t *const cut = malloc(size);
      memcpy(cut, words, size);
      if ((stated != 0U) && (4U * place + 4U < size)) {
        cut[place] = (int32_t)size;
      }
      cut[size / 4U - 1U] = (int32_t)crc32_of_words(cut, size / 4U - 1U);
      accepted += qj_load(&policy, &race, cut, size) == QJ_OK;
      free(cut);
    }
  }
  return accepted;
}
int main(int argc, char **argv) {
  static int32_t all[65536];
  static uint32_t edits[4];
  FILE *const file = fopen(argv[1], "rb");
  FILE *const list = fopen(argv[2], "rb");
  const uint32_t bytes = (uint32_t)fread(all, 1, sizeof(all), file);
  int32_t *const words = malloc(bytes); /* no word more, so that a read beyond is seen */
  memcpy(words, all, bytes);
  if ((argc != 4) || (lengths(words, bytes, (uint32_t)atoi(argv[3])) != 0)) {
    return 2;
  }
  while (fread(edits, sizeof(edits), 1, list) == 1) {
    uint8_t error;
    fuzz(words, bytes, edits, &error, 1);
    putchar(error);
  }
  free(words);
  return 0;
}
""")  # fmt: skip
    edits = edits_of(data, count, seed)
    (folder / "words.bin").write_bytes(data)
    edits.tofile(folder / "edits.bin")
    command = [need("gcc"), *SANITIZERS, f"-I{RUNTIME}", str(folder / "fuzz.c"), *map(str, FILES)]
    subprocess.run([*command, "-o", str(folder / "fuzz")], check=True)
    arguments = [str(folder / name) for name in ("fuzz", "words.bin", "edits.bin")]
    arguments.append(str(at_of(data, "header", "bytes")))
    done = subprocess.run(arguments, capture_output=True)
    assert done.returncode == 0, done.stderr[:500]
    return edits, np.frombuffer(done.stdout, np.uint8)


def changed_by(data, edit):
    return edited(data, {int(edit[0]): np.uint32(edit[1]).view(np.int32),
                         int(edit[2]): np.uint32(edit[3]).view(np.int32)})  # fmt: skip


@pytest.mark.parametrize("kind", ["racing", pytest.param("everything", marks=pytest.mark.slow)])
def test_python_accepts_what_the_loader_accepts(kind, data, tmp_path):
    words = data if kind == "racing" else everything()[1]
    edits, errors = fuzzed(words, 1500, tmp_path)
    accepted = np.flatnonzero(errors == 0)
    refused = np.flatnonzero(errors)
    assert len(accepted) > 3 and len(np.unique(errors)) > 5
    for number in (*accepted[:60], *refused[:200]):
        changed = changed_by(words, edits[number])
        try:
            unpack(changed)
            fine = True
        except InputError:
            fine = False
        assert fine == (errors[number] == 0), (edits[number], errors[number])
