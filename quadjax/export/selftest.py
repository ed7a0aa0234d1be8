"""What the emitted self-tests compare with: inputs and the integers that follow from them."""

import dataclasses

import numpy as np

from quadjax.export import battery_emulator, emulator, estimator_emulator, race_emulator
from quadjax.export.battery_tables import BatteryTables
from quadjax.export.estimator_tables import FINE_BITS, EstimatorTables
from quadjax.export.fixed import FixedLayer, FixedNetwork
from quadjax.export.integers import INPUT_BITS, WORD, digest, status_flags, words_of
from quadjax.export.race_tables import RaceTables
from quadjax.export.vectors import self_test_inputs

BLOCK = 4  # rows of a block
TURN = 8  # columns, and rows of a hidden layer, are padded to a multiple of this
PROBE_FACTOR, PROBE_TERM = 1664525, 1013904223
# Bit patterns that the self-test quantizes in every position.
PATTERNS = np.array(
    (
        *(0x00000000, 0x80000000, 0x00000001, 0x807FFFFF, 0x3F800000, 0xBF800000, 0x3E99999A),
        *(0x40490FDB, 0xC0490FDB, 0x41000001, 0xC1800000, 0x7F7FFFFF, 0xFF7FFFFF),
        *(0x7F800000, 0xFF800000, 0x7FC00000, 0xFFC00000, 0x7F800001, 0xFFFFFFFF, 0x358637BD),
    ),
    np.uint32,
)
RANDOM_STATES, SIMULATED_STATES = 6, 10
HISTORY_ROUNDS = 6  # of the test's states, of which a digest is compared where there is a history
MEASUREMENTS, SAMPLES = 16, 64  # of the estimator: the measurements are repeated


@dataclasses.dataclass(frozen=True)
class PaddedLayer:
    """A layer as the C has it: rows and columns padded with zeros."""

    weights: np.ndarray  # (padded rows * padded columns,) int32, in blocks
    bias: np.ndarray  # (padded rows,) int64
    rows: int  # of the policy
    columns: int  # padded


@dataclasses.dataclass(frozen=True)
class NetworkTest:
    """Inferences, hashes and probes of the network's self-test."""

    inputs: np.ndarray  # (n, inputs) int32
    commands: np.ndarray  # (n, outputs) int32
    traces: np.ndarray  # (n,) uint32
    kinds: str  # what the inputs are
    tables_hash: int
    probes: list[int]  # digest of each layer's sums for the probe inputs
    patterns: np.ndarray  # uint32
    quantize_digest: int


@dataclasses.dataclass(frozen=True)
class RaceTest:
    """States and the network inputs that follow from them."""

    states: np.ndarray  # (n, state_size) uint32, the bits
    targets: np.ndarray  # (n,)
    inputs: np.ndarray  # (n, inputs) int32
    status: np.ndarray  # (n, 3) uint32: clipped, nan, outside
    rounds: int  # in which the states are repeated after that
    digest: int  # of the inputs of these rounds


@dataclasses.dataclass(frozen=True)
class EstimatorTest:
    """Measurements and the estimator's channels after each sample."""

    measurements: np.ndarray  # (MEASUREMENTS, 13) uint32, the bits
    outputs: np.ndarray  # (SAMPLES, 6) int64, upper words


@dataclasses.dataclass(frozen=True)
class BatteryTest:
    """Samples of the estimator of the highest speed, and a digest of its memory after each."""

    samples: np.ndarray  # (MEASUREMENTS, 8) uint32, the bits
    digests: np.ndarray  # (SAMPLES,) uint32


def pad(layer: FixedLayer, shift: int, multiple: int) -> PaddedLayer:
    """The layer's tables in the kernels' order; padded rows hold only the rounding half."""
    rows, columns = layer.weights.shape
    padded_rows, padded_columns = -(-rows // multiple) * multiple, -(-columns // TURN) * TURN
    weights = np.zeros((padded_rows, padded_columns), np.int32)
    weights[:rows, :columns] = layer.weights
    bias = np.full(padded_rows, 2 ** (shift - 1), np.int64)
    bias[:rows] = layer.bias
    blocks = weights.reshape(-1, BLOCK, padded_columns).transpose(0, 2, 1)
    return PaddedLayer(blocks.ravel(), bias, rows, padded_columns)


def padded_layers(network: FixedNetwork) -> list[PaddedLayer]:
    """All layers of a network, padded."""
    hidden = [pad(layer, WORD, TURN) for layer in network.hidden]
    return [*hidden, pad(network.output, network.output_shift, BLOCK)]


def network_test(
    network: FixedNetwork, layers: list[PaddedLayer], observations: np.ndarray | None
) -> NetworkTest:
    """The network's self-test, with some of the simulated ``observations`` (n, inputs)."""
    inputs, kinds = self_test_inputs(network, observations)
    commands, trace = emulator.forward_traced(network, inputs)
    tables = [part for layer in layers for part in (layer.weights, words_of(layer.bias))]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))
    return NetworkTest(
        inputs=inputs,
        commands=commands,
        traces=emulator.trace_digest(trace),
        kinds=counts,
        tables_hash=_digest(np.concatenate(tables, dtype=np.int64)),
        probes=[_probe_digest(layer) for layer in layers],
        patterns=PATTERNS,
        quantize_digest=_quantize_digest(network),
    )


def _digest(words: np.ndarray) -> int:
    return int(digest(np.asarray(words, np.int64).reshape(1, -1) & 0xFFFFFFFF)[0])


def _probe_digest(layer: PaddedLayer) -> int:
    """Digest of a layer's sums for the C's probe inputs."""
    state, inputs = 1, []
    for _ in range(layer.columns):
        state = (state * PROBE_FACTOR + PROBE_TERM) & 0xFFFFFFFF
        inputs.append((state >> 16) | 1)
    blocks = layer.weights.astype(np.int64).reshape(-1, layer.columns, BLOCK)
    sums = np.einsum("bcr,c->br", blocks, np.array(inputs, np.int64)).ravel() + layer.bias
    return _digest(words_of(sums))


def _quantize_digest(network: FixedNetwork) -> int:
    """Digest of every test pattern in every position, quantized."""
    everywhere = np.repeat(PATTERNS.view(np.float32)[:, None], network.inputs, axis=1)
    q, _, _ = emulator.quantize(network, everywhere)
    flags = status_flags(everywhere, network.box.exponents)
    return _digest(np.stack([np.asarray(w, np.int64) for w in (q, *flags)], axis=2))


def race_test(tables: RaceTables, states: np.ndarray, targets: np.ndarray) -> RaceTest:
    """The observation's self-test: simulated states, random ones and NaN."""
    rng = np.random.default_rng(0)
    ranges = np.ldexp(1.0, np.asarray(tables.exponents))
    shape = (RANDOM_STATES, len(ranges))
    random = (rng.uniform(-0.5, 0.5, shape) * ranges).astype(np.float32)
    random[0] *= np.float32(10.0)
    random[1, :] = np.nan
    goals = rng.integers(0, tables.gates, RANDOM_STATES)
    pick = np.linspace(0, len(states) - 1, SIMULATED_STATES).astype(int)
    chosen = np.concatenate([random, states[pick].astype(np.float32)])
    goals = np.concatenate([goals, targets[pick]])
    count, rounds = len(chosen), HISTORY_ROUNDS if tables.history else 0
    again = np.tile(chosen, (1 + rounds, 1)), np.tile(goals, 1 + rounds)
    observed = race_emulator.observe(tables, *again)
    status = np.stack([observed.clipped, observed.nan, observed.outside], axis=1)[:count]
    bits = np.ascontiguousarray(chosen).view(np.uint32)
    digest = _digest(observed.q[count:].astype(np.int64))
    return RaceTest(bits, goals, observed.q[:count], status, rounds, digest)


def estimator_test(tables: EstimatorTables) -> EstimatorTest:
    """The estimator's self-test: random measurements, one clipped and one with a NaN."""
    rng = np.random.default_rng(0)
    limit = np.ldexp(1.0, np.asarray(tables.exponents))
    rows = rng.uniform(-0.3, 0.3, (MEASUREMENTS, len(limit))) * limit
    rows[:, 6:10] = np.abs(rows[:, 6:10]) * 2.0
    rows[-1] *= 8.0  # clipped
    rows[-2, 2] = np.nan
    measured = rows.astype(np.float32)
    memory = estimator_emulator.start(tables, measured[:1])
    samples = [measured[sample % MEASUREMENTS][None] for sample in range(SAMPLES)]
    fine = [estimator_emulator.update(tables, memory, sample)[0] for sample in samples]
    return EstimatorTest(measured.view(np.uint32), np.stack(fine) >> (FINE_BITS - INPUT_BITS))


def battery_test(tables: BatteryTables) -> BatteryTest:
    """The self-test of the highest speed: commands below and at it, one clipped, one with a NaN."""
    rng = np.random.default_rng(0)
    shape, top = (MEASUREMENTS, 4), tables.highest * tables.unit
    command = np.where(rng.random(shape) < 0.5, 1.0, rng.uniform(0.3, 1.0, shape)) * top
    rows = np.concatenate([rng.uniform(0.7, 1.0, shape) * top, command], axis=1)
    rows[-1] *= 8.0  # clipped
    rows[-2, 2] = rows[-3, 6] = np.nan
    samples = rows.astype(np.float32)
    memory, digests = battery_emulator.start(tables, samples[:1]), []
    for number in range(SAMPLES):
        if number and number % (MEASUREMENTS // 2) == 0:  # to both limits of the estimate
            memory.highest[:] = tables.highest if number % MEASUREMENTS else tables.lowest
        if number:
            battery_emulator.update(tables, memory, samples[number % MEASUREMENTS][None])
        digests.append(digest(memory.words)[0])
    return BatteryTest(samples.view(np.uint32), np.array(digests))
