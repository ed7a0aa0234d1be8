"""Checks of the bits: sources, emulators, the host's C, hostile inputs, accuracy, mutations."""

import ctypes
import re
from collections.abc import Sequence

import jax
import numpy as np

from quadjax.export.actor import fixed_point_forward
from quadjax.export.integers import bit_mask
from quadjax.export.report import float64_commands, uniform_samples
from quadjax.export.selftest import BLOCK, padded_layers
from quadjax.export.verify.context import Context
from quadjax.export.verify.harness import float_commands, float_library, load_library
from quadjax.export.verify.result import require
from quadjax.export.verify.toolchain import WARNINGS, Compiler, host

ACCURACY_SAMPLES = 100_000
LARGEST_ERROR = 1e-4  # of the range of a command
RANDOM_BITS = 50


def check_proof(c: Context) -> str:
    """The proof is repeated when the folder is read; this reports it."""
    bits = max(c.folder.proof.accumulator_bits)
    bound, policy = c.folder.proof.error_bound, c.folder.policy
    part = float(np.max(bound / (policy.command_high - policy.command_low)))
    return (
        f"largest sum 2^{bits:.3f} < 2^63 for every input; error at most "
        f"{float(np.max(bound)):.3g} {c.folder.network.unit}, {part:.2g} of a command's range"
    )


def check_warnings(
    c: Context, compiler: Compiler | None = None, extra: Sequence[str] = ("-O3",)
) -> str:
    """No warning under the strict set, from the host's compiler or another."""
    compiler = compiler or host()
    for source in c.folder.files:
        compiler.build([source], c.work / "warnings.o", [*WARNINGS, *extra, "-c"])
    return f"{compiler.name}, {len(WARNINGS) - 1} warning options, none raised"


def check_jax(c: Context) -> str:
    """JAX and NumPy agree."""
    forward = jax.jit(jax.vmap(fixed_point_forward(c.folder.network)))
    size = 8192
    for start in range(0, c.count, size):
        part = c.vectors[start : start + size]
        found = np.asarray(forward(np.resize(part, (size, part.shape[1]))))[: len(part)]
        wrong = np.any(found != c.expected[start : start + size, :4], axis=1)
        require(not wrong.any(), f"{wrong.sum()} vectors differ, first {start + wrong.argmax()}")
    found = np.asarray(forward(c.hostile))
    require(bool(np.all(found == c.expected_hostile[:, :4])), "hostile vectors differ")
    return f"{c.count} vectors, the same commands"


def check_host(c: Context) -> str:
    """The host's C and NumPy agree: commands, every accumulator, status."""
    require(c.library.self_test() == 0, "self-test mismatches")
    c.same(host().name, c.library.infer(c.vectors), c.expected)
    return f"{host().name}: {c.count} vectors, the same commands, sums and status"


def check_hostile(c: Context) -> str:
    """NaN, infinite, huge and subnormal inputs give commands in range and the right status."""
    rows = c.library.infer(c.hostile)
    c.same("hostile vectors", rows, c.expected_hostile)
    network = c.folder.network
    low, high = network.command_low, network.command_high
    require(bool(np.all((rows[:, :4] >= low) & (rows[:, :4] <= high))), "a command out of range")
    nan = bit_mask(np.isnan(c.hostile))
    beyond = ~np.isnan(c.hostile) & (np.abs(c.hostile) > network.box.ranges)
    clipped = bit_mask(beyond)
    require(bool(np.all(rows[:, 6].view(np.uint32) == nan)), "wrong NaN status")
    require(bool(np.all(rows[:, 5].view(np.uint32) == clipped)), "wrong clipped status")
    command = c.library.command(c.hostile).astype(np.float64)
    unit = 2.0**network.fraction_bits
    require(
        bool(np.all((command >= low / unit - 1e-6) & (command <= high / unit + 1e-6))),
        "a command of the forward function out of range",
    )
    return f"{len(rows)} vectors: in range, right status"


def check_accuracy(c: Context) -> str:
    """Largest error of the C that flies against float64, next to that of float32 C."""
    folder = c.folder
    box = uniform_samples(folder.network, ACCURACY_SAMPLES, 3)
    library, parts = float_library(folder, host(), c.work), []
    span = folder.policy.command_high - folder.policy.command_low
    for name, x in (("box", box), ("simulated", folder.rollouts.observations)):
        exact = float64_commands(folder.policy, x)
        commands = c.flying.infer(x)[:, :4] / 2.0**folder.network.fraction_bits
        fixed, single = (
            float(np.max(np.abs(found - exact) / span))
            for found in (commands, float_commands(library, x))
        )
        parts.append(f"{name} {fixed:.2g} (float32 C: {single:.2g}) of a command's range")
        require(fixed <= LARGEST_ERROR, f"{parts[-1]}: above {LARGEST_ERROR:g}")
    return "; ".join(parts)


def _mutant(c: Context, text: str, name: str) -> ctypes.CDLL:
    """A mutated source without the check of the tables' hash; vectors and probes still apply."""
    work = c.work / name
    work.mkdir(exist_ok=True)
    source = work / f"{c.folder.name}.c"
    source.write_text(text.replace("(tables_hash() != TABLES_HASH)", "(tables_hash() == 0U)"))
    return load_library(host(), [source], work / "mutant.so", [f"-I{c.folder.path}"])


def check_mutations(c: Context) -> str:
    """A flipped bit, a dropped rounding term and a wrong shift are caught by the vectors alone."""
    folder = c.folder
    shift = "sum >> 32" if folder.network.hidden else f"sum >> {folder.network.output_shift}"
    wrong = shift[:-2] + str(int(shift[-2:]) - 1)
    text = folder.expected[f"{folder.name}.c"]
    require(shift in text, f"nothing to mutate: {shift!r}")
    shifted = _mutant(c, text.replace(shift, wrong, 1), "shift")
    caught_shift = int(getattr(shifted, f"{folder.name}_self_test")())
    require(caught_shift > 0, "a shift of 31 was not caught")
    tables, network = _Tables(c), folder.network
    halves = [2**31] * len(network.hidden) + [2 ** (network.output_shift - 1)]
    for layer, half in enumerate(halves):
        require(tables.add(layer, -half) > 0, f"layer {layer}: dropped rounding was not caught")
    caught = [_flip_caught(c, tables, number) for number in range(RANDOM_BITS)]
    require(all(caught), f"{RANDOM_BITS - sum(caught)} flipped bits were not caught")
    return (
        f"shift of 31, dropped rounding in each of {len(halves)} layers and {sum(caught)} of "
        f"{RANDOM_BITS} random bits caught"
    )


def _flip_caught(c: Context, tables: "_Tables", number: int) -> bool:
    """Whether the vectors and probes of the self-test see one flipped weight bit."""
    rng = np.random.default_rng(1000 + number)
    layers = c.folder.network.layers
    sizes = np.array([layer.weights.size for layer in layers])
    index = int(rng.choice(len(layers), p=sizes / sizes.sum()))
    row = int(rng.integers(layers[index].weights.shape[0]))
    column = int(rng.integers(layers[index].weights.shape[1]))
    return tables.flip(index, row, column, int(rng.integers(32))) > 0


class _Tables:
    """The C with its tables writable and without their hash: only vectors and probes are left."""

    def __init__(self, c: Context) -> None:
        folder = c.folder
        text = folder.expected[f"{folder.name}.c"]
        text = re.sub(r"static const (int\d\d_t (?:weight|bias)_\d+\[)", r"\1", text)
        self._library = _mutant(c, text, "tables")
        self._test = getattr(self._library, f"{folder.name}_self_test")
        self._network = folder.network
        require(int(self._test()) == 0, "the unmutated tables fail")

    def flip(self, layer: int, row: int, column: int, bit: int) -> int:
        """Mismatches with one bit of one weight flipped; then restored."""
        padded = padded_layers(self._network)[layer]
        place = (row // BLOCK) * padded.columns * BLOCK + column * BLOCK + row % BLOCK
        table = (ctypes.c_uint32 * padded.weights.size).in_dll(self._library, f"weight_{layer}")
        expected = int(self._network.layers[layer].weights[row, column]) & 0xFFFFFFFF
        require(table[place] == expected, "the table is not at its expected place")
        table[place] ^= 1 << bit
        found = int(self._test())
        table[place] ^= 1 << bit
        return found

    def add(self, layer: int, term: int) -> int:
        """Mismatches with a term added to the bias of a layer's last row; then restored."""
        biases = self._network.layers[layer].bias
        table = (ctypes.c_int64 * len(biases)).in_dll(self._library, f"bias_{layer}")
        require(table[len(biases) - 1] == int(biases[-1]), "the bias is not at its expected place")
        table[len(biases) - 1] += term
        found = int(self._test())
        table[len(biases) - 1] -= term
        return found
