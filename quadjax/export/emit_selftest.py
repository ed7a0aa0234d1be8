"""The emitted self-test: padded tables, their hash, probes, whole inferences and the quantiser."""

import dataclasses

import numpy as np

from quadjax.export import emulator
from quadjax.export.fixed import WORD, FixedLayer, FixedNetwork
from quadjax.export.render import rows_table, wrapped
from quadjax.export.vectors import SelfTest

BLOCK = 4  # rows of a block
TURN = 8  # columns, and rows of a hidden layer, are padded to a multiple of this
PROBE_FACTOR, PROBE_TERM = 1664525, 1013904223
# Bit patterns that the self-test quantises in every position.
QUANTIZE_PATTERNS = (
    *(0x00000000, 0x80000000, 0x00000001, 0x807FFFFF, 0x3F800000, 0xBF800000, 0x3E99999A),
    *(0x40490FDB, 0xC0490FDB, 0x41000001, 0xC1800000, 0x7F7FFFFF, 0xFF7FFFFF),
    *(0x7F800000, 0xFF800000, 0x7FC00000, 0xFFC00000, 0x7F800001, 0xFFFFFFFF, 0x358637BD),
)


@dataclasses.dataclass(frozen=True)
class PaddedLayer:
    """A layer as the C has it: rows and columns padded with zeros."""

    weights: np.ndarray  # (padded rows * padded columns,) int32, in blocks
    bias: np.ndarray  # (padded rows,) int64
    rows: int  # of the policy
    columns: int  # padded


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


def tables_hash(layers: list[PaddedLayer]) -> int:
    """Digest of every table, as ``tables_hash`` in the C computes it."""
    words = []
    for layer in layers:
        words.append(layer.weights.astype(np.int64) & 0xFFFFFFFF)
        bias = layer.bias
        words.append(np.stack([bias & 0xFFFFFFFF, (bias >> 32) & 0xFFFFFFFF], axis=1).ravel())
    return digest(np.concatenate(words))


def digest(words: np.ndarray) -> int:
    """FNV-1a over 32-bit words, one after another."""
    value = emulator.DIGEST_START
    for word in words.tolist():
        value = ((value ^ word) * emulator.DIGEST_FACTOR) & 0xFFFFFFFF
    return value


def probe_digest(layer: PaddedLayer) -> int:
    """Digest of a layer's sums for the C's probe inputs."""
    state, inputs = 1, []
    for _ in range(layer.columns):
        state = (state * PROBE_FACTOR + PROBE_TERM) & 0xFFFFFFFF
        inputs.append((state >> 16) | 1)
    blocks = layer.weights.astype(np.int64).reshape(-1, layer.columns, BLOCK)
    sums = np.einsum("bcr,c->br", blocks, np.array(inputs, np.int64)).ravel() + layer.bias
    return digest(np.stack([sums & 0xFFFFFFFF, (sums >> 32) & 0xFFFFFFFF], axis=1).ravel())


def quantize_digest(network: FixedNetwork) -> int:
    """Digest of every test pattern in every position, quantised."""
    patterns = np.array(QUANTIZE_PATTERNS, np.uint32).view(np.float32)
    everywhere = np.repeat(patterns[:, None], network.inputs, axis=1)
    q, clipped, nan = emulator.quantize(network, everywhere)
    place = np.arange(network.inputs, dtype=np.uint32)
    words = [
        q.astype(np.int64) & 0xFFFFFFFF,
        (clipped[:, None] >> place) & 1,
        (nan[:, None] >> place) & 1,
    ]
    return digest(np.stack([np.asarray(w, np.int64) for w in words], axis=2).ravel())


def self_test_tables(
    network: FixedNetwork, layers: list[PaddedLayer], test: SelfTest, name: str
) -> dict[str, str]:
    """The constants, vectors and patterns of the self-test, as C."""
    command, trace = emulator.forward_traced(network, test.inputs)
    constants = [f"#define TABLES_HASH UINT32_C({tables_hash(layers)})"]
    constants += [
        f"#define PROBE_{index} UINT32_C({probe_digest(layer)})"
        for index, layer in enumerate(layers)
    ]
    constants.append(f"#define QUANTIZE_DIGEST UINT32_C({quantize_digest(network)})")
    patterns = wrapped(f"0x{p:08X}U" for p in QUANTIZE_PATTERNS)
    kinds = ", ".join(f"{test.kinds.count(k)} {k}" for k in dict.fromkeys(test.kinds))
    text = [
        "\n".join(constants) + "\n",
        f"/* {kinds}. */\n" + rows_table("int32_t", "test_input", "[TEST_VECTORS][@]", test.inputs),
        rows_table("int32_t", "test_command", "[TEST_VECTORS][@@]", command),
        "/* Digest of every accumulator of each vector. */\n"
        "static const uint32_t test_trace[TEST_VECTORS] = {\n"
        + wrapped(f"0x{d:08X}U" for d in emulator.trace_digest(trace).tolist())
        + "};\n",
        QUANTIZE_TEST.replace("PATTERNS", patterns)
        .replace("COUNT", str(len(QUANTIZE_PATTERNS)))
        .replace("@name@", name),
    ]
    joined = "\n".join(text)
    joined = joined.replace("[@@]", f"[{network.outputs}]").replace("[@]", f"[{network.inputs}]")
    return {"vector_tables": joined}


QUANTIZE_TEST = """\
/* Zeros, subnormals, ordinary and huge numbers, infinities and NaNs: in every position. */
static const uint32_t quantize_pattern[COUNT] = {
PATTERNS};

static uint32_t quantize_fails(void) {
  uint32_t digest = DIGEST_START;
  for (uint32_t pattern = 0U; pattern < COUNTU; ++pattern) {
    for (uint32_t i = 0U; i < sizeof(range_exponent); ++i) {
      uint32_t clipped;
      uint32_t nan;
      const uint32_t bits = quantize_pattern[pattern];
      const int32_t q = @name@_quantize_one(bits, range_exponent[i], &clipped, &nan);
      digest = digest_word(digest_word(digest_word(digest, (uint32_t)q), clipped), nan);
    }
  }
  return (digest != QUANTIZE_DIGEST) ? 1U : 0U;
}
"""
