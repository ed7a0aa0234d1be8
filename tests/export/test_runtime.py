"""The C runtime, whatever the policy: warnings, analyzers, processors, self-tests."""

import functools
import shutil
import subprocess
import sys

import numpy as np
import pytest

from benchmarks import eva
from benchmarks.instructions_boards import Board, sample_vehicle
from benchmarks.instructions_builds import BUILDS, arm_none_eabi, bebop
from quadjax.export import emulator
from quadjax.export import library as library_module
from quadjax.export.compiler import Compiler, Skipped, host
from quadjax.export.integers import quantize
from quadjax.export.library import HOST, write_c
from quadjax.export.vectors import check_vectors, hostile_vectors
from tests.export.support import WARNINGS, converted, library

LARGEST_STACK = 3072  # bytes
BRANCHES = 40  # instructions that depend on whether an input or a command is clamped
SANITIZERS = "-fsanitize=address,undefined -fno-sanitize-recover=all -g -O1".split()


def need(program):
    """Skip unless a program is on the path."""
    if shutil.which(program) is None:
        pytest.skip(f"no {program} on this machine")
    return program


@pytest.mark.slow
def test_no_compiler_warns(tmp_path):
    of = converted("everything", tmp_path / "policy", sampled=True)
    files = write_c(of, tmp_path / "c")
    for make in (host, bebop, functools.partial(arm_none_eabi, "cortex-m4")):
        try:
            compiler = make()
        except Skipped:
            continue
        for source in files:
            extra = [*WARNINGS, "-O3", f"-I{tmp_path / 'c'}", "-c"]
            compiler.build([source], tmp_path / "warnings.o", extra)


def test_cppcheck_finds_nothing(tmp_path):
    command = [need("cppcheck"), "--enable=warning,performance,portability", "--error-exitcode=1"]
    files = write_c(converted("everything", tmp_path / "policy"), tmp_path / "c")
    command += ["--std=c99", "--quiet", "--suppress=missingIncludeSystem", f"-I{tmp_path / 'c'}"]
    done = subprocess.run([*command, *map(str, files)], capture_output=True, text=True)
    assert done.returncode == 0 and not done.stderr.strip(), done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("processor", BUILDS)
@pytest.mark.parametrize("hidden", [(33, 7, 18), ()])  # that no block divides, and no hidden layer
def test_every_kernel_has_the_bits_of_numpy_on_board(hidden, processor, tmp_path):
    """And its instructions and stack hardly depend on the numbers."""
    of = converted("published e2e", tmp_path / "policy", hidden)
    network, missing = of.in_c.network, []
    x = np.concatenate([check_vectors(network, 400, None), hostile_vectors(network)])
    q = quantize(x, network.box.exponents).astype(np.int32)
    on_host = library(of, tmp_path / "host").pilot(of.frequency).call(0, sample_vehicle())[1]
    for build in BUILDS[processor]:
        try:
            board = Board(of, processor, build, tmp_path)
        except Skipped as reason:
            missing.append(str(reason))
            continue
        if build.has_math:  # whole rpm
            np.testing.assert_allclose(board.step(sample_vehicle()), on_host, atol=1.0)
        np.testing.assert_array_equal(board.forward(q), emulator.forward_rows(network, q))
        counts, stacks = zip(*(board.count("infer", row) for row in x[:400:10]), strict=True)
        assert max(counts) - min(counts) <= BRANCHES + 8 * network.inputs, build.label
        assert max(*stacks, board.count("step", sample_vehicle())[1]) < LARGEST_STACK
    if missing:
        pytest.skip("; ".join(missing))


ZIG = Compiler("zig cc", (sys.executable, "-m", "ziglang", "cc"), ("-std=c99",))


@pytest.mark.slow
@pytest.mark.parametrize("compiler", [host, lambda: ZIG], ids=["host", "clang"])
def test_fast_math_changes_no_bit_of_the_network_and_lets_no_nan_in(
    compiler, tmp_path, monkeypatch
):
    """INDIflight and Betaflight are built with it."""
    of = converted("everything", tmp_path / "policy")
    monkeypatch.setattr(library_module, "host", compiler)
    c = library(of, tmp_path / "c", "-O2", "-ffast-math")
    network = of.in_c.network
    x = np.concatenate([check_vectors(network, 400, None), hostile_vectors(network)])
    q = quantize(x, network.box.exponents)
    np.testing.assert_array_equal(c.quantize(x), q)
    np.testing.assert_array_equal(c.forward(q), emulator.forward_rows(network, q))
    pilot, vehicle = c.pilot(of.frequency), sample_vehicle()
    for call in range(20):
        vehicle["time_us"] = vehicle["position_us"] = round(1e6 * call / of.frequency)
        vehicle["rates"] = np.nan if call % 2 else 0.1
        pilot.call(int(vehicle["time_us"][0]), vehicle)
    assert pilot.counts()["nan calls"] == 10 and np.isfinite(pilot.estimate()).all()


CHANGES = {  # of the C: what stands there, what stands there then
    "shift of 31": (">sums[row] >> WORD", ">sums[row] >> 31"),
    "no ReLU": ("(upper > 0) ? upper : 0", "upper"),
    "output shift": ("(int32_t)(sum >> ", "(int32_t)(sum >> 1 + "),
    "no clamp": (
        "const int64_t sum = limited(sums[i], policy",
        "const int64_t sum = high0(sums[i], policy",
    ),
    "another row": ("of->sums[row] = of->bias[row]", "of->sums[row] = of->bias[0]"),
}


@pytest.mark.slow
@pytest.mark.skipif(np.dtype(np.intp).itemsize != 8, reason="the plain kernel is that of a PC")
def test_the_self_test_sees_a_change_of_the_c(tmp_path):
    of = converted("published e2e", tmp_path / "policy", (16, 16))
    assert library(of, tmp_path / "right").pilot(of.frequency).wrong is None
    source = f"{of.target.folder}/qj_network.c"
    text = of.files[source].decode()
    for name, (old, new) in CHANGES.items():
        assert text.count(old) == 1, name
        changed = text.replace(old, new).replace(
            "void qj_forward(", "#define high0(x, low, high) (x)\nvoid qj_forward("
        )
        vars(of)["files"] = of.files | {source: changed.encode()}
        assert library(of, tmp_path / name.replace(" ", "_")).pilot(of.frequency).wrong, name


def test_the_self_test_sees_a_change_of_every_table(tmp_path):
    of = converted("published e2e", tmp_path / "policy")
    header = f"{of.target.folder}/made.h"
    text = of.files[header].decode()
    tables = ("made_inputs", "made_gates", "made_gate_constants", "made_weights_0", "made_bias_1")
    for table in tables:
        start = text.index(f" {table}[")
        at = text.index("7", text.index("{", start))  # a digit of a number of this table
        changed = text[:at] + "6" + text[at + 1 :]
        vars(of)["files"] = of.files | {header: changed.encode()}
        assert library(of, tmp_path / table).pilot(of.frequency).wrong == "its self-test fails", (
            table
        )


REPLAY = """
#include <stdio.h>
#include "qj_pilot.h"
#include "quadjax_policy.h"
int main(void) {
  static qj_pilot pilot;
  qj_vehicle vehicle;
  float command[QJ_COMMANDS];
  if (qj_pilot_start(&pilot, &QUADJAX_POLICY, QJ_DEFAULT_KERNEL, 512.0F) != 0) { return 1; }
  pilot.noise = 1U;
  for (uint32_t now = 0U; fread(&vehicle, sizeof(vehicle), 1, stdin) == 1; now += 1953U) {
    if (vehicle.time_us % 7U == 0U) { qj_pilot_standby(&pilot, &vehicle); }
    (void)qj_pilot_call(&pilot, now, (vehicle.time_us % 5U == 0U) ? 0 : &vehicle, command);
    fwrite(command, sizeof(command), 1, stdout);
  }
  return 0;
}
"""


@pytest.mark.slow
def test_states_of_any_bits_under_sanitizers(tmp_path):
    of = converted("everything", tmp_path / "policy", sampled=True)
    files = [path for path in write_c(of, tmp_path / "c") if path.parent != HOST]
    (tmp_path / "replay.c").write_text(REPLAY)
    flags = [*SANITIZERS, f"-I{tmp_path / 'c'}", "-lm"]
    host().build([*files, tmp_path / "replay.c"], tmp_path / "replay", flags)
    rows = np.repeat(sample_vehicle(), 20_000)
    bits = np.random.default_rng(0).integers(0, 2**32, rows.nbytes // 4, dtype=np.uint32)
    words, rng = rows.view(np.uint32), np.random.default_rng(1)
    hostile = rng.random(len(words)) < 0.02
    words[hostile] = bits[hostile]
    rows["time_us"] = 1953 * np.arange(len(rows)) + rng.integers(-2, 3, len(rows))
    rows["position_us"] = rows["time_us"]
    done = subprocess.run([tmp_path / "replay"], input=rows.tobytes(), capture_output=True)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    commands = np.frombuffer(done.stdout, np.float32).reshape(-1, 4)
    assert len(commands) == len(rows)
    assert np.all((commands == 0.0) | ((commands >= 3000.0) & (commands <= 11_000.0)))
    assert (commands > 0.0).mean() > 0.5


@pytest.mark.slow
def test_frama_c_has_no_alarm(tmp_path):
    need("frama-c")
    of = converted("racing, axes and more", tmp_path / "policy")
    assert eva.analyze(of, tmp_path / "right")[:2] == (0, True)
    name = f"{of.target.folder}/made.h"
    text, first = of.files[name].decode(), of.in_c.tables[0][0][:8].tolist()
    row = ", ".join(map(str, first))
    assert row in text
    largest = text.replace(row, ", ".join([str(2**31 - 1)] * 8), 1)  # sums may overflow
    for at in range(8, 4 * 24, 8):
        row = ", ".join(map(str, of.in_c.tables[0][0][at : at + 4].tolist()))
        largest = largest.replace(row, ", ".join([str(2**31 - 1)] * 4), 1)
    vars(of)["files"] = of.files | {name: largest.encode()}
    assert eva.analyze(of, tmp_path / "wrong")[0] > 0
