"""The emitted network, built with this machine's compiler."""

import ctypes

import numpy as np
import pytest

from quadjax.export import emulator
from quadjax.export.fixed import convert
from quadjax.export.proof import prove
from quadjax.export.vectors import check_vectors, hostile_vectors
from quadjax.export.verify.emitted import write_memory
from quadjax.export.verify.result import Skipped
from quadjax.export.verify.toolchain import WARNINGS, host, zig_arm, zig_thumb
from tests.export.support import POLICIES, made_policy, named_network, write_network


@pytest.fixture(scope="module")
def compiler():
    try:
        return host()
    except Skipped as reason:
        pytest.skip(str(reason))


def build(compiler, source, extra=()):
    output = source.parent / f"{source.stem}.so"
    compiler.build([source], output, ["-shared", "-fPIC", *extra])
    return ctypes.CDLL(str(output))


class Status(ctypes.Structure):
    _fields_ = [("clipped", ctypes.c_uint32), ("nan", ctypes.c_uint32)]


def infer(library, network, x):
    """Commands, trace and status of every row, through the public functions."""
    library.made_quantize.restype = Status
    library.made_forward_traced.restype = ctypes.c_uint32
    q, out = (ctypes.c_int32 * network.inputs)(), (ctypes.c_int32 * 4)()
    rows = []
    for row in np.ascontiguousarray(x, np.float32):
        status = library.made_quantize(row.ctypes.data_as(ctypes.c_void_p), q)
        trace = library.made_forward_traced(0, q, out)
        rows.append([*out, trace, status.clipped, status.nan])
    return np.array(rows, np.int64)


FEW = ["odd", "linear"]  # sizes that no block divides, and no hidden layer
SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in POLICIES if name not in FEW]


@pytest.mark.parametrize("name", [*FEW, *SLOW])
def test_the_same_bits_without_a_warning(name, compiler, tmp_path):
    policy, network = named_network(name)
    prove(network, policy)
    library = build(compiler, write_network(network, tmp_path), [*WARNINGS, "-O3"])
    assert library.made_self_test() == 0
    x = np.concatenate([check_vectors(network, 800, None), hostile_vectors(network)])
    q, clipped, nan = emulator.quantize(network, x)
    command, trace = emulator.forward_traced(network, q)
    columns = [*command.T, emulator.trace_digest(trace), clipped, nan]
    assert np.array_equal(infer(library, network, x), np.stack(columns, axis=1).astype(np.int64))


@pytest.mark.slow
@pytest.mark.parametrize("name", POLICIES)
def test_both_kernels_on_a_cortex_a9(name, tmp_path):
    for module in ("unicorn", "elftools", "ziglang"):
        pytest.importorskip(module)
    from quadjax.export.verify.machine import Machine

    sources = [write_network(named_network(name)[1], tmp_path), write_memory(tmp_path)]
    elf = zig_arm(neon=True).build(sources, tmp_path / "arm.elf", ["-Wl,-e,made_forward"])
    machine = Machine(elf)
    assert [machine.call("made_self_test_with", kernel) for kernel in (0, 1)] == [0, 0]


@pytest.mark.slow
@pytest.mark.parametrize("processor", ["Cortex-M7", "Cortex-M4"])
def test_the_network_on_a_microcontroller(processor, tmp_path):
    for module in ("unicorn", "elftools", "ziglang"):
        pytest.importorskip(module)
    from quadjax.export.verify.machine import Machine

    sources = [write_network(named_network("odd")[1], tmp_path), write_memory(tmp_path)]
    counts = []
    for options in ([], ["-DMADE_PORTABLE=1"]):
        elf = tmp_path / f"{len(options)}.elf"
        zig_thumb(processor).build(sources, elf, ["-Wl,-e,made_forward", *options])
        machine = Machine(elf, processor)
        assert machine.call("made_self_test_with", 0) == 0
        x = machine.place(np.zeros(24, np.float32))
        out = [machine.reserve(16), 0, x, machine.reserve(16)]
        counts.append(machine.count("made_forward_with", *out)[0])
    assert counts[0] < counts[1]


def test_any_integer_input_is_defined(compiler, tmp_path):
    policy, network = named_network("rate")
    library = build(compiler, write_network(network, tmp_path))
    q, out = (ctypes.c_int32 * 17)(*[-(2**31), 2**31 - 1] * 8, 0), (ctypes.c_int32 * 4)()
    library.made_forward_q(q, out)
    assert list(out) == emulator.forward_q(network, np.array([list(q)]))[0].tolist()


MUTATIONS = {
    "shift of 31": ("sum >> 32", "sum >> 31"),
    "no ReLU": ("(upper > 0) ? upper : 0", "upper"),
    "output shift": ("(int32_t)(sum >> ", "(int32_t)(sum >> 1 + "),
    "NaN not seen": ("*nan = (magnitude > INFINITY_BITS) ? 1U : 0U", "*nan = 0U"),
    "late clipping": ("? limit : magnitude;", "? magnitude : magnitude;"),
}


def test_the_self_test_catches_a_mutation(compiler, tmp_path):
    network = convert(made_policy(16))
    for number, (name, (old, new)) in enumerate(MUTATIONS.items()):
        (tmp_path / str(number)).mkdir()
        source = write_network(network, tmp_path / str(number))
        text = source.read_text()
        assert old in text
        source.write_text(text.replace(old, new, 1))
        assert build(compiler, source).made_self_test() > 0, name


def test_the_header_says_where_it_comes_from(tmp_path):
    _, network = named_network("motor 64")
    source = write_network(network, tmp_path)
    header = source.with_suffix(".h").read_text()
    for word in ("POLICY_SHA256", "FORMAT_VERSION", "MADE_SOURCE", "DETERMINISTIC", "made up"):
        assert word in header
    for word in ("malloc", "math.h", "expf", "double"):
        assert word not in source.read_text()


def test_the_source_is_the_same_every_time(tmp_path):
    first, second = tmp_path / "a", tmp_path / "b"
    for folder in (first, second):
        folder.mkdir()
        write_network(convert(made_policy(16)), folder)
    assert (first / "made.c").read_text() == (second / "made.c").read_text()
