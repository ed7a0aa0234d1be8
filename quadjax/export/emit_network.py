"""The emitted network: one header and one source, from the tables of a ``FixedNetwork``."""

import dataclasses

import numpy as np

from quadjax.export import emulator
from quadjax.export.fixed import (
    FORMAT_VERSION,
    TANH_FRACTION_BITS,
    TANH_LIMIT,
    WORD,
    FixedLayer,
    FixedNetwork,
)
from quadjax.export.ranges import UNITS
from quadjax.export.render import (
    comment,
    fill,
    literal_64,
    rows_table,
    string,
    table,
    wrapped,
)
from quadjax.export.squash import (
    SEGMENT_BITS,
    SEGMENTS_PER_UNIT,
    VALUE_BITS,
    coefficients,
)
from quadjax.export.squash import UNITS as TANH_UNITS
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
class Provenance:
    """Where the C came from, for its headers."""

    name: str  # the prefix of every symbol
    policy_hash: str  # SHA-256 of the policy file
    lines: tuple[str, ...]  # what a reader of the header is told
    source: str  # one line


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


def emit_network(network: FixedNetwork, origin: Provenance, test: SelfTest) -> dict[str, str]:
    """The header and the source, by file name."""
    layers = padded_layers(network)
    values = _common(network, origin, len(test.inputs), len(layers))
    values |= (
        _tables(network, layers) | _calls(layers) | _vectors(network, layers, test, origin.name)
    )
    hidden = fill("hidden_layer.c.in", values) if network.hidden else ""
    values |= {"hidden_layer": hidden}
    values |= {"squash": _squash(network), "command_function": _command_function(network, values)}
    return {
        f"{origin.name}.h": fill("network.h.in", values),
        f"{origin.name}.c": fill("network.c.in", values),
    }


def _common(network: FixedNetwork, origin: Provenance, vectors: int, layers: int) -> dict[str, str]:
    motor = network.vehicle == "motor"
    ranges = network.box.ranges
    lines = [
        f"{i:3d}  {name:<17} +-{limit:g} {UNITS[name.split('[')[0]]}"
        for i, (name, limit) in enumerate(zip(network.box.names, ranges, strict=True))
    ]
    low, high = (
        x / 2.0**network.fraction_bits for x in (network.command_low, network.command_high)
    )
    return {
        "name": origin.name,
        "NAME": origin.name.upper(),
        "provenance": comment(origin.lines),
        "policy_hash": origin.policy_hash,
        "source": string(origin.source),
        "format_version": str(FORMAT_VERSION),
        "inputs": str(network.inputs),
        "outputs": str(network.outputs),
        "fraction_bits": str(network.fraction_bits),
        "unit": "rpm" if motor else "rad/s and m/s^2",
        "input_list": comment(lines),
        "low": ", ".join(f"{x:g}" for x in (low[:1] if len(set(low)) == 1 else low)),
        "high": ", ".join(f"{x:g}" for x in (high[:1] if len(set(high)) == 1 else high)),
        "command_type": "uint16_t" if motor else "float",
        "command_comment": (
            "rpm, to the nearest" if motor else "p, q, r in rad/s and specific thrust in m/s^2"
        ),
        "vectors": str(vectors),
        "self_tests": str(vectors + layers + 2),
        "exponents": ", ".join(map(str, network.box.exponents)),
    }


def _tables(network: FixedNetwork, layers: list[PaddedLayer]) -> dict[str, str]:
    dimensions, text = [], []
    for index, layer in enumerate(layers):
        dimensions.append(
            f"  ROWS_{index} = {layer.rows}, PADDED_ROWS_{index} = {layer.bias.size}, "
            f"COLUMNS_{index} = {layer.columns},"
        )
        text.append(
            f"/* Layer {index}: {layer.rows} rows of {layer.columns} columns, padded. */\n"
            + table("int32_t", f"weight_{index}", str(layer.weights.size), layer.weights)
        )
        text.append(table("int64_t", f"bias_{index}", str(layer.bias.size), layer.bias))
    widest = max(layer.columns for layer in layers)
    return {
        "dimensions": "\n".join(dimensions),
        "widest": str(widest),
        "tables": "\n".join(text),
    }


def _calls(layers: list[PaddedLayer]) -> dict[str, str]:
    calls, buffers = [], ("a", "b")
    for index in range(len(layers) - 1):
        x, y = buffers[index % 2], buffers[(index + 1) % 2]
        calls.append(
            f"  hidden_layer(kernel, weight_{index}, bias_{index}, ROWS_{index}, "
            f"PADDED_ROWS_{index}, COLUMNS_{index}, {x}, {y}, trace);"
        )
    last = len(layers) - 1
    calls.append(
        f"  block_sums(kernel, weight_{last}, bias_{last}, {buffers[last % 2]}, COLUMNS_{last}, "
        "sums);"
    )
    hashes, probes = [], []
    for index, layer in enumerate(layers):
        hashes += [
            f"  digest = digest_table_32(digest, weight_{index}, {layer.weights.size}U);",
            f"  digest = digest_table_64(digest, bias_{index}, {layer.bias.size}U);",
        ]
        call = (
            f"probe_layer(kernel, weight_{index}, bias_{index}, PADDED_ROWS_{index}, "
            f"COLUMNS_{index})"
        )
        probes.append(f"  mismatches += ({call} != PROBE_{index}) ? 1U : 0U;")
    return {
        "layer_calls": "\n".join(calls),
        "second_buffer": "  int32_t b[WIDEST];\n" if last else "",
        "hash_calls": "\n".join(hashes),
        "probe_calls": "\n".join(probes),
    }


def _vectors(
    network: FixedNetwork, layers: list[PaddedLayer], test: SelfTest, name: str
) -> dict[str, str]:
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


def _squash(network: FixedNetwork) -> str:
    """``output_command``: clamp and shift, or tanh and the command's range."""
    size = str(network.outputs)
    low, high = network.command_low.tolist(), network.command_high.tolist()
    shift = network.output_shift
    if network.squash == "clip":
        limits = [
            table("int64_t", "sum_low", size, np.array(low) << shift),
            table("int64_t", "sum_high", size, np.array(high) << shift),
        ]
        return (
            "/* Clamped in the accumulator's own units, so that the shift cannot overflow. */\n"
            + "".join(limits)
            + f"\nstatic int32_t output_command(int64_t sum, uint32_t i) {{\n"
            f"  const int64_t low = sum_low[i];\n"
            f"  const int64_t high = sum_high[i];\n"
            f"  sum = (sum < low) ? low : sum;\n"
            f"  sum = (sum > high) ? high : sum;\n"
            f"  return (int32_t)(sum >> {shift});\n}}\n"
        )
    middle = [(a + b << VALUE_BITS) + (1 << VALUE_BITS) for a, b in zip(low, high, strict=True)]
    span = [b - a for a, b in zip(low, high, strict=True)]
    tables = [
        rows_table("int32_t", "tanh_cubic", f"[{len(coefficients())}][4]", coefficients()),
        table("int64_t", "command_middle", size, np.array(middle, np.int64)),
        table("int32_t", "command_span", size, np.array(span)),
        table("int32_t", "command_low", size, np.array(low)),
        table("int32_t", "command_high", size, np.array(high)),
    ]
    constants = {
        "LIMIT": literal_64(TANH_LIMIT << (TANH_FRACTION_BITS + shift)),
        "SHIFT": str(shift),
        "LAST": str((TANH_UNITS * SEGMENTS_PER_UNIT << SEGMENT_BITS) - 1),
        "SEGMENT_BITS": str(SEGMENT_BITS),
        "PLACE": str((1 << SEGMENT_BITS) - 1),
        "ONE": str(1 << VALUE_BITS),
        "LOWEST": str(VALUE_BITS + 1),
    }
    text = TANH_FUNCTIONS
    for key, value in constants.items():
        text = text.replace(f"<{key}>", value)
    return (
        "/* tanh: cubics over segments of 1/32, coefficients in Q30 of the place in a segment. */\n"
        + "\n".join(tables)
        + text
    )


TANH_FUNCTIONS = """
static int64_t clamp_64(int64_t value, int64_t low, int64_t high) {
  value = (value < low) ? low : value;
  return (value > high) ? high : value;
}

static int32_t tanh_q30(int32_t z_q27) {
  const int32_t sign = 1 - (int32_t)(((uint32_t)z_q27 >> 31) << 1);
  const int32_t magnitude = (int32_t)clamp_64((int64_t)z_q27 * sign, 0, <LAST>);
  const int32_t *const cubic = tanh_cubic[magnitude >> <SEGMENT_BITS>];
  const int64_t place = magnitude & <PLACE>;
  int64_t value = cubic[3];
  value = cubic[2] + ((value * place) >> <SEGMENT_BITS>);
  value = cubic[1] + ((value * place) >> <SEGMENT_BITS>);
  value = cubic[0] + ((value * place) >> <SEGMENT_BITS>);
  return (int32_t)clamp_64(value, 0, <ONE>) * sign;
}

static int32_t output_command(int64_t sum, uint32_t i) {
  const int32_t z_q27 = (int32_t)(clamp_64(sum, -<LIMIT>, <LIMIT>) >> <SHIFT>);
  const int64_t doubled = command_middle[i] + (int64_t)command_span[i] * tanh_q30(z_q27);
  return (int32_t)clamp_64(doubled >> <LOWEST>, command_low[i], command_high[i]);
}
"""


def _command_function(network: FixedNetwork, values: dict[str, str]) -> str:
    name, size, kind = values["name"], values["NAME"] + "_OUTPUTS", values["command_type"]
    bits = network.fraction_bits
    if network.vehicle == "motor":
        body = f"    command[i] = (uint16_t)((q[i] + (INT32_C(1) << {bits - 1})) >> {bits});"
    else:
        body = f"    command[i] = (float)q[i] * {2.0**-bits!r}F; /* exact: 2^-{bits} */"
    return (
        f"void {name}_command(const int32_t q[{size}], {kind} command[{size}]) {{\n"
        f"  for (uint32_t i = 0U; i < {size}; ++i) {{\n{body}\n  }}\n}}\n"
    )
