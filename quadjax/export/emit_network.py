"""The emitted network: one header and one source, from the tables of a ``FixedNetwork``."""

import dataclasses

import numpy as np

from quadjax.export.emit_selftest import PaddedLayer, padded_layers, self_test_tables
from quadjax.export.fixed import (
    FORMAT_VERSION,
    TANH_FRACTION_BITS,
    TANH_LIMIT,
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
)
from quadjax.export.squash import (
    SEGMENT_BITS,
    SEGMENTS_PER_UNIT,
    VALUE_BITS,
    coefficients,
)
from quadjax.export.squash import UNITS as TANH_UNITS
from quadjax.export.vectors import SelfTest


@dataclasses.dataclass(frozen=True)
class Provenance:
    """Where the C came from, for its headers."""

    name: str  # the prefix of every symbol
    policy_hash: str  # SHA-256 of the policy file
    lines: tuple[str, ...]  # what a reader of the header is told
    source: str  # one line


def emit_network(network: FixedNetwork, origin: Provenance, test: SelfTest) -> dict[str, str]:
    """The header and the source, by file name."""
    layers = padded_layers(network)
    values = _common(network, origin, len(test.inputs), len(layers))
    values |= _tables(network, layers) | _calls(layers)
    values |= self_test_tables(network, layers, test, origin.name)
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


def _squash(network: FixedNetwork) -> str:
    """``output_command``: clamp and shift, or tanh and the command's range."""
    return _clip_command(network) if network.squash == "clip" else _tanh_command(network)


def _clip_command(network: FixedNetwork) -> str:
    size, shift = str(network.outputs), network.output_shift
    limits = [
        table("int64_t", "sum_low", size, network.command_low.astype(np.int64) << shift),
        table("int64_t", "sum_high", size, network.command_high.astype(np.int64) << shift),
    ]
    return (
        "/* Clamped in the accumulator's own units, so that the shift cannot overflow. */\n"
        + "".join(limits)
        + "\nstatic int32_t output_command(int64_t sum, uint32_t i) {\n"
        "  const int64_t low = sum_low[i];\n"
        "  const int64_t high = sum_high[i];\n"
        "  sum = (sum < low) ? low : sum;\n"
        "  sum = (sum > high) ? high : sum;\n"
        f"  return (int32_t)(sum >> {shift});\n}}\n"
    )


def _tanh_command(network: FixedNetwork) -> str:
    size, shift = str(network.outputs), network.output_shift
    low, high = network.command_low.tolist(), network.command_high.tolist()
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
