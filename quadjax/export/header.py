"""A policy as constant arrays and a struct in C: ``NAME.h``, and the headers next to it."""

import itertools
import textwrap
from collections.abc import Iterable, Sequence

import jax
import numpy as np

from quadjax.export import emulator
from quadjax.export.policy_in_c import MULTIPLE, PolicyInC, padded
from quadjax.export.race_source import PolicyRace
from quadjax.export.suitability import kind_of
from quadjax.export.targets import RATES
from quadjax.race import episode

WIDTH, INDENT = 100, "    "
SMALLEST_WIDTH = 16  # of the runtime's buffers: the inputs of a residual


# ---- text ----------------------------------------------------------------------------------------


def real(value: object) -> str:
    """A number as a float of C, with the digits that it has."""
    return f"{np.float32(np.asarray(value))!s}F"


def reals(values: Iterable[object]) -> str:
    """Numbers in braces."""
    return "{" + ", ".join(map(real, values)) + "}"


def _integer(value: int) -> str:
    return str(value) if value > -(2**31) else "(-2147483647 - 1)"


def array(kind: str, name: str, items: Sequence[str], comment: str = "") -> str:
    """A constant array; items of one line each if the text of one ends with a comment."""
    of_lines = bool(items) and items[0].endswith("*/")
    text = "".join(f"{INDENT}{x}\n" for x in items) if of_lines else _wrapped(items)
    said = f"/* {comment} */\n" if comment else ""
    return f"{said}static const {kind} {name}[{len(items)}] = {{\n{text}}};\n"


def _wrapped(items: Sequence[str]) -> str:
    """Items in lines of at most ``WIDTH`` characters."""
    return textwrap.fill(
        ", ".join(items),
        WIDTH,
        initial_indent=INDENT,
        subsequent_indent=INDENT,
        break_on_hyphens=False,
        break_long_words=False,
    )


def comment_block(lines: Iterable[str]) -> str:
    """Lines of a block comment, in which no text can end it."""
    text = "\n".join(f" * {line}".rstrip() for line in lines)
    return "/*\n" + text.replace("*/", "* /").replace("/*", "/ *") + "\n */\n"


def struct(kind: str, name: str, fields: dict[str, str]) -> str:
    """A constant struct, one field a line."""
    lines = "".join(f"{INDENT}.{field} = {value},\n" for field, value in fields.items())
    return f"static const {kind} {name} = {{\n{lines}}};\n"


# ---- parts of NAME.h -----------------------------------------------------------------------------


def policy_header(policy: PolicyInC, facts: Iterable[str]) -> str:
    """``NAME.h``: the policy as ``NAME_policy``, with facts about its source."""
    guard, name, network = policy.name.upper(), policy.name, policy.network
    unit = 2.0**network.fraction_bits
    low, high = network.command_low / unit, network.command_high / unit
    units = [signal.unit or "1" for signal in network.model.commands for _ in range(signal.size)]
    ends = zip(low.tolist(), high.tolist(), units, strict=True)
    lines = [f"{name}: a quadcopter racing policy. Written by quadjax export; do not edit.", ""]
    lines += [*facts, "Commands " + ", ".join(f"{a:g}..{b:g} {unit}" for a, b, unit in ends)]
    parts = [
        comment_block(lines),
        f'#ifndef {guard}_H\n#define {guard}_H\n\n#include "qj.h"\n',
        _observation(policy),
        _gates(policy),
        *_layers(policy),
        *_estimators(policy),
        _self_tests(policy),
        struct("qj_policy", f"{name}_policy", _fields(policy)),
        f"#endif /* {guard}_H */\n",
    ]
    return "\n".join(parts)


def _observation(policy: PolicyInC) -> str:
    """The fields of the observation, and the scale and range of each input."""
    o, box, name = policy.observation, policy.network.box, policy.name
    names = box.layout.names
    parts = [
        f"{{{part}, {size}}}, /* {x} */" for (part, size), x in zip(o.parts, names, strict=True)
    ]
    rows = zip(box.layout.labels, o.scales, box.ranges, box.units, strict=True)
    inputs = [
        f"{{{real(middle)}, {real(factor)}, {real(limit)}}}, /* {label}{_unit(unit)} */"
        for label, (middle, factor), limit, unit in rows
    ]
    said = "Inputs (value - middle) factor of the network, each within +-range"
    return array("qj_part", f"{name}_parts", parts, "Fields of the observation") + array(
        "qj_input", f"{name}_inputs", inputs, said
    )


def _unit(unit: str) -> str:
    return f", {unit}" if unit else ""


def _gates(policy: PolicyInC) -> str:
    o, name = policy.observation, policy.name
    rows = []
    for number, (gate, is_round) in enumerate(zip(o.gates, o.is_round, strict=True)):
        axes = "{" + ", ".join(reals(axis) for axis in gate["axes"]) + "}"
        others = [real(gate[x]) for x in gate.dtype.names[2:]]
        row = f"{reals(gate['position'])}, {axes}, {', '.join(others)}, {int(is_round)}U"
        rows.append(f"{{{row}}}, /* gate {number} */")
    said = "Center, axes, yaw, its cosine and sine, half of width and height less the body, round"
    constants = [real(x) for x in o.constants.ravel()] or ["0.0F"]
    return array("qj_gate", f"{name}_gates", rows, said) + array(
        "float", f"{name}_gate_constants", constants, "Inputs that depend on the target gate alone"
    )


def _layers(policy: PolicyInC) -> Iterable[str]:
    name, layers, rows = policy.name, policy.network.layers, []
    for number, (layer, (weights, bias)) in enumerate(zip(layers, policy.tables, strict=True)):
        count, columns = layer.weights.shape
        height, width = padded(count, columns, layer is not layers[-1])
        size = f"{count}U, {columns}U, {height}U, {width}U"
        rows.append(f"{{{size}, {name}_weights_{number}, {name}_bias_{number}}}, /* {number} */")
        items = [_integer(x) for x in weights.tolist()]
        yield array("int32_t", f"{name}_weights_{number}", items, "In blocks of four rows")
        longs = [f"INT64_C({x})" for x in bias.tolist()]
        yield array("int64_t", f"{name}_bias_{number}", longs)
    yield array("qj_layer", f"{name}_layers", rows, "Rows, columns, the same padded, tables")


def _estimators(policy: PolicyInC) -> Iterable[str]:
    name = policy.name
    if (model := policy.disturbance) is not None:
        residual = "0"
        if model.residual is not None:
            residual, numbers = f"&{name}_residual", model.residual
            for label in ("thrust", "moment"):
                yield from _float_layers(f"{name}_{label}", getattr(numbers, label))
            counts = {f"{x}_layers": f"{len(getattr(numbers, x))}U" for x in ("thrust", "moment")}
            ends = {"low_rpm": real(numbers.low_rpm), "high_rpm": real(numbers.high_rpm)}
            tables = {x: f"{name}_{x}_layers" for x in ("thrust", "moment")}
            yield struct("qj_residual", f"{name}_residual", ends | counts | tables)
        fields = {"sample_rate": real(model.sample_rate)}
        fields |= {key: real(value) for key, value in model.constants.items()}
        fields |= {x: reals(getattr(model, x)) for x in ("inertia", "feedback", "low_pass")}
        fields |= {"derivative": reals(model.derivative), "residual": residual}
        yield struct("qj_disturbance_model", f"{name}_disturbance", fields)
    if policy.battery is not None:
        fields = {key: real(value) for key, value in vars(policy.battery).items()}
        yield struct("qj_battery_model", f"{name}_battery", fields)
    if policy.noise is not None:
        said = "Standard deviations of the commands"
        yield array("float", f"{name}_noise", [real(x) for x in policy.noise], said)


def _float_layers(name: str, layers: Sequence[tuple[np.ndarray, np.ndarray]]) -> Iterable[str]:
    """The tables of a float network, and its layers."""
    rows = []
    for number, (weights, bias) in enumerate(layers):
        tables = {"weights": weights.ravel(), "bias": bias}
        for label, values in tables.items():
            yield array("float", f"{name}_{label}_{number}", [real(x) for x in values])
        names = ", ".join(f"{name}_{label}_{number}" for label in tables)
        rows.append("{{{}U, {}U, {}}}, /* {} */".format(*weights.shape, names, number))
    yield array("qj_float_layer", f"{name}_layers", rows)


def _self_tests(policy: PolicyInC) -> str:
    name, inputs = policy.name, policy.test_inputs
    rows = emulator.forward_rows(policy.network, inputs)
    texts = [[_integer(x) for x in values.ravel().tolist()] for values in (inputs, rows[:, :-1])]
    traces = [f"{x}U" for x in rows[:, -1].view(np.uint32).tolist()]
    return (
        array("int32_t", f"{name}_test_inputs", texts[0], "Self-tests: inputs of the network")
        + array("int32_t", f"{name}_test_commands", texts[1], "their commands")
        + array("uint32_t", f"{name}_test_traces", traces, "digests of every sum")
    )


def _fields(policy: PolicyInC) -> dict[str, str]:
    """The fields of ``qj_policy``."""
    name, network, o = policy.name, policy.network, policy.observation
    low, high = (
        "{" + ", ".join(_integer(x) for x in ends.tolist()) + "}"
        for ends in (network.command_low, network.command_high)
    )
    counts = {
        "inputs": network.inputs,
        "layers": len(network.layers),
        "parts": len(o.parts),
        "gates": len(o.gates),
        "gate_constants": o.constants.shape[1],
        "output_shift": network.output_shift,
        "fraction_bits": network.fraction_bits,
    }
    tables = ("layer", "part", "input", "gate", "gate_constant")
    return {
        "name": f'"{name}"',
        "kind": kind_of(network.model.name),
        "step_s": real(o.time_step),
        **{key: f"{value}U" for key, value in counts.items()},
        "low": low,
        "high": high,
        **{table: f"{name}_{table}s" for table in tables},
        "gate_test": f"QJ_{o.gate_test.upper()}",
        "disturbance": "0" if policy.disturbance is None else f"&{name}_disturbance",
        "battery": "0" if policy.battery is None else f"&{name}_battery",
        "noise": "0" if policy.noise is None else f"{name}_noise",
        "noise_on_clamped": f"{int(policy.noise_on_clamped)}U",
        "hash": f"{policy.hash}U",
        "tests": f"{len(policy.test_inputs)}U",
        "test_input": f"{name}_test_inputs",
        "test_command": f"{name}_test_commands",
        "test_trace": f"{name}_test_traces",
    }


# ---- other headers -------------------------------------------------------------------------------


def sizes_header(policy: PolicyInC) -> str:
    """``qj_sizes.h``: no buffer of the runtime is larger than the policy needs."""
    shapes = [layer.weights.shape for layer in policy.network.layers]
    if policy.disturbance is not None and (residual := policy.disturbance.residual) is not None:
        shapes += [weights.shape for weights, _ in (*residual.thrust, *residual.moment)]
    widest = max(SMALLEST_WIDTH, *itertools.chain(*shapes))
    width = -(-widest // MULTIPLE) * MULTIPLE
    return (
        f"/* Sizes of {policy.name}. */\n#ifndef QJ_SIZES_H\n#define QJ_SIZES_H\n\n"
        f"#ifndef QJ_MAX_WIDTH\n#define QJ_MAX_WIDTH {width}\n#endif\n\n#endif /* QJ_SIZES_H */\n"
    )


def glue_header(policy: PolicyInC, race: PolicyRace, frequency: float) -> str:
    """``quadjax_policy.h``: what the glue of an autopilot needs of its policy."""
    gates = policy.observation.gates
    drone = episode.hover_start(race.environment, race.params).drone
    rows = ", ".join(reals(gate["position"]) for gate in gates)
    kind = kind_of(policy.network.model.name)
    values = {
        "QUADJAX_POLICY": f"{policy.name}_policy",
        "QUADJAX_COMMANDS_RATES": int(kind == RATES),
        "QUADJAX_FREQUENCY": real(frequency),
        "NUM_GATES": len(gates),
        "QUADJAX_GATE_POSITIONS": "{" + rows + "}",
        "QUADJAX_GATE_YAWS": reals(gates["yaw"]),
        "QUADJAX_START_POSITION": reals(jax.tree.leaves(drone.position)),
        "QUADJAX_START_YAW": real(drone.euler.z),
    }
    lines = "\n".join(f"#define {name} {value}" for name, value in values.items())
    return (
        "/* The policy that the glue flies: gates and start in m and rad, north-east-down. */\n"
        f'#ifndef QUADJAX_POLICY_H\n#define QUADJAX_POLICY_H\n\n#include "{policy.name}.h"\n\n'
        f"{lines}\n\n#endif /* QUADJAX_POLICY_H */\n"
    )
