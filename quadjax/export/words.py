"""The words of a policy: what the C runtime runs, and the bytes of a ``.qjp`` file.

``STRUCTS`` names every word: ``pack`` and ``read_words`` go by it, and ``runtime/qj_words.h`` is
made from it. The words are little-endian and follow each other: header, sizes of the layers, state,
observation, track, weights, estimators, self-tests, and a CRC-32 of all of it.
"""

import dataclasses
import zlib
from collections.abc import Iterator

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.battery_tables import MOTORS, BatteryTables, Factor
from quadjax.export.cases import (
    BLOCK,
    HISTORY_ROUNDS,
    MEASUREMENTS,
    SAMPLES,
    TURN,
    Cases,
    padded_layers,
)
from quadjax.export.estimator_tables import (
    CHANNELS,
    FINE_BITS,
    MONOMIALS,
    EstimatorTables,
    FixedResidual,
)
from quadjax.export.fixed import FixedLayer, FixedNetwork
from quadjax.export.integers import DIGEST_START, ONE
from quadjax.export.race_tables import (
    ATTITUDE,
    COPY,
    GATE,
    NOTES,
    POSITION,
    QUATERNION_EXPONENT,
    ROTATION,
    SCALED,
    VELOCITY,
    YAW_EXPONENT,
    Input,
    RaceTables,
    StateField,
)
from quadjax.export.ranges import InputBox
from quadjax.export.scaling import Rescale
from quadjax.race.layout import Field, Layout, split_name
from quadjax.race.observations import fields_of
from quadjax.vehicle.registry import MODELS

MAGIC, VERSION, COMMANDS = 0x00504A51, 2, 4
NAME_BYTES, FIELD_BYTES = 32, 24
KINDS = (POSITION, VELOCITY, ATTITUDE, ROTATION, COPY, SCALED, GATE)  # numbered from 1 on
STATE_FIELDS = (  # numbered from 1 on
    *("position", "velocity", "euler", "quaternion", "rates", "rotor_speed"),
    *("moment_ext", "force_ext", "last_command", "rpm", "thrust", "highest_rpm"),
)
COMMAND_KINDS = {"rpm": 1, "motor_command": 2}  # by the name of the commands
OTHER_COMMANDS = 3
LARGEST_SHIFT, LARGEST_EXPONENT = 60, 30
ZERO = Rescale(0, 0, 1)  # of an input that is no scaled number, or always zero
SIZES = {"quaternion": 4, "rotor_speed": 4, "rpm": 4, "last_command": 4, "thrust": 1}
SIZES |= {"highest_rpm": 1}  # of fields of the state; all others have 3 numbers


def _struct(*fields: str | tuple[str, str] | tuple[str, str, int]) -> np.dtype:
    """Words by name; one int32 unless a type, and a count, are given."""
    return np.dtype([(field, "<i4") if isinstance(field, str) else field for field in fields])


STRUCTS = {
    "header": _struct(
        *("magic", "version", "bytes", "inputs", "layers", "state_size", "fields", "parts"),
        *("gates", "constants", "world_box", "kind", "output_shift", "fraction_bits"),
        *("period_ns", "network_tests", "race_tests", ("history_digest", "<u4")),
        *("estimator", "battery", ("source", "<u4", 8), ("name", "<u4", NAME_BYTES // 4)),
        *(("vehicle", "<u4", 4), ("low", "<i4", COMMANDS), ("high", "<i4", COMMANDS)),
    ),
    "layer": _struct("rows", "columns"),
    "field": _struct("code", "start", "size"),
    "part": _struct("kind", "index", "size", "exponent", "lag", ("name", "<u4", FIELD_BYTES // 4)),
    "input": _struct("source", "middle", "factor", "shift"),
    "gate": _struct(
        *(("position", "<i4", 3), ("axes", "<i4", 9), "cosine", "sine"),
        *("half_width", "half_height", "round", ("yaw", "<i8")),
    ),
    "estimator": _struct(
        *("period_ns", ("exponents", "<i4", 13), ("channels", "<i4", len(CHANNELS)), "terms"),
        *("thrust_layers", "moment_layers", "rpm_middle", "rpm_factor", "rpm_shift"),
        *("thrust_shift", ("moment_shift", "<i4", 3), ("a1", "<i8"), ("a2", "<i8")),
        ("gain", "<i8"),
    ),
    "term": _struct("channel", "monomial", ("factor", "<i8")),
    "battery": _struct(
        *("period_ns", "exponent", "low_pass", "low_pass_shift", "lead", "lead_shift"),
        *("gain", "gain_shift", ("lowest", "<i8"), ("highest", "<i8"), ("first", "<i8")),
    ),
}
HEADER = STRUCTS["header"]


@dataclasses.dataclass(frozen=True)
class FixedPolicy:
    """A policy as integers: what the words contain."""

    name: str  # of the table in C
    network: FixedNetwork  # of a file: without the real values of its units
    race: RaceTables
    estimator: EstimatorTables | None  # of the disturbances
    battery: BatteryTables | None  # of the highest rpm
    policy_hash: str  # SHA-256 of the policy file
    time_step: float  # s
    cases: Cases


def layout_header() -> str:
    """``runtime/qj_words.h``: the place of every word in its structure."""
    values = {"magic": MAGIC, "version": VERSION, "yaw_exponent": YAW_EXPONENT}
    values |= {"quaternion_exponent": QUATERNION_EXPONENT, "fine_bits": FINE_BITS}
    values |= {"battery_bits": 40, "test_rows": MEASUREMENTS, "test_samples": SAMPLES}
    values |= {"history_rounds": HISTORY_ROUNDS, "measurements": 13}
    values |= {"monomials": len(MONOMIALS), "channels": len(CHANNELS)}
    values |= {f"see_{kind}": number for number, kind in enumerate(KINDS, start=1)}
    for name, struct in STRUCTS.items():
        places = {f"{name}_{field}": struct.fields[field][1] // 4 for field in struct.names or ()}
        values |= places | {f"{name}_words": struct.itemsize // 4}
    lines = ",\n".join(f"  QJ_{name.upper()} = {value}" for name, value in values.items())
    return (
        "/* The place of every word of a policy in its structure. Made from the table of words.py\n"
        " * by python -m quadjax.export.words; a test compares. */\n#ifndef QJ_WORDS_H\n"
        f"#define QJ_WORDS_H\n\nenum {{\n{lines}\n}};\n\n#endif /* QJ_WORDS_H */\n"
    )


# ---- writing -------------------------------------------------------------------------------------


def pack(policy: FixedPolicy) -> bytes:
    """A policy as the bytes of its words.

    Raises:
        InputError: a policy that the format cannot represent.
    """
    _check_names(policy)
    parts = [_header(policy), *_body(policy), *_case_words(policy)]
    data = bytearray(b"".join(part.tobytes() for part in parts))
    place = HEADER.fields["bytes"][1]
    data[place : place + 4] = np.uint32(len(data) + 4).tobytes()
    return bytes(data) + np.uint32(zlib.crc32(data)).tobytes()


def _check_names(policy: FixedPolicy) -> None:
    race = policy.race
    unknown = [field.name for field in race.fields if field.name not in STATE_FIELDS]
    if unknown:
        raise InputError(f"{unknown[0]}: no state of a .qjp, allowed: {', '.join(STATE_FIELDS)}")
    texts = {part.name: FIELD_BYTES for part in race.inputs} | {policy.name: NAME_BYTES}
    for text, size in texts.items():
        if len(text) >= size:
            raise InputError(f"name {text}: allowed: up to {size - 1} letters")
    shifts = [r.shift for part in race.inputs for r in part.rescales if r is not None]
    if policy.network.outputs != COMMANDS or not all(1 <= x <= LARGEST_SHIFT for x in shifts):
        raise InputError(f"allowed: {COMMANDS} commands, and scales of 2^-1 to 2^-{LARGEST_SHIFT}")


def _text(data: str, size: int) -> np.ndarray:
    padded = data.encode("ascii", "replace")[: size - 1].ljust(size, b"\0")
    return np.frombuffer(padded, "<u4")


def _words(values: object, dtype: str = "<i4") -> np.ndarray:
    """Integers as words.

    Raises:
        InputError: one that does not fit.
    """
    numbers, limits = np.asarray(values).ravel().astype(np.int64), np.iinfo(dtype)
    if np.any((numbers < limits.min) | (numbers > limits.max)):
        raise InputError("a number of the policy does not fit in its word of a .qjp")
    return numbers.astype(dtype)


def _rows(name: str, rows: list[dict[str, object]]) -> np.ndarray:
    """Structures of ``STRUCTS`` from their fields."""
    found = np.zeros(len(rows), STRUCTS[name])
    for row, values in zip(found, rows, strict=True):
        for field, value in values.items():
            kind = STRUCTS[name][field].base.str
            numbers = _words(value, kind)
            row[field] = numbers if np.ndim(row[field]) else numbers[0]
    return found


def _header(policy: FixedPolicy) -> np.ndarray:
    network, race, cases = policy.network, policy.race, policy.cases
    return _rows("header", [{
        "magic": MAGIC, "version": VERSION, "inputs": network.inputs,
        "layers": len(network.layers), "state_size": race.state_size,
        "fields": len(race.fields), "parts": len(race.inputs), "gates": race.gates,
        "constants": race.next_gate.shape[1], "world_box": int(race.world_box),
        "kind": COMMAND_KINDS.get(network.model.commands[0].name, OTHER_COMMANDS),
        "output_shift": network.output_shift, "fraction_bits": network.fraction_bits,
        "period_ns": round(policy.time_step * 1e9),
        "network_tests": len(cases.inputs), "race_tests": len(cases.states),
        "history_digest": cases.history_digest,
        "estimator": int(policy.estimator is not None),
        "battery": int(policy.battery is not None),
        "source": np.frombuffer(bytes.fromhex(policy.policy_hash), "<u4"),
        "name": _text(policy.name, NAME_BYTES), "vehicle": _text(network.model.name, 16),
        "low": network.command_low, "high": network.command_high,
    }])  # fmt: skip


def _body(policy: FixedPolicy) -> Iterator[np.ndarray]:
    network, race = policy.network, policy.race
    yield _sizes(network.layers)
    yield _rows("field", [
        {"code": 1 + STATE_FIELDS.index(field.name), "start": field.start,
         "size": len(field.exponents)} for field in race.fields
    ])  # fmt: skip
    yield _words(race.exponents)
    yield _rows("part", [
        {"kind": 1 + KINDS.index(part.kind), "index": part.index,
         "size": race.box.layout[part.name].size, "exponent": race.box.exponent[part.name],
         "lag": part.lag, "name": _text(part.name, FIELD_BYTES)} for part in race.inputs
    ])  # fmt: skip
    for part in race.inputs:
        yield _rows("input", [
            {"source": source, "middle": own.middle, "factor": own.factor, "shift": own.shift}
            for source, own in _numbers(part, race.box.layout[part.name].size)
        ])  # fmt: skip
    gates = _rows("gate", [
        {"position": race.gate_position[g], "axes": _axes(race, g), "cosine": race.gate_cos[g],
         "sine": race.gate_sin[g], "half_width": race.half_size[g][0],
         "half_height": race.half_size[g][1], "yaw": race.gate_yaw[g],
         "round": 0 if race.circle is None else int(race.circle[g])} for g in range(race.gates)
    ])  # fmt: skip
    constants = _words(race.next_gate).reshape(race.gates, -1)
    yield np.concatenate([gates.view("<i4").reshape(race.gates, -1), constants], axis=1)
    yield from _tables(network.hidden, network.output, network.output_shift)
    if policy.estimator is not None:
        yield from _estimator(policy.estimator)
    if policy.battery is not None:
        yield _battery(policy.battery)


def _sizes(layers: tuple[FixedLayer, ...]) -> np.ndarray:
    shapes = [layer.weights.shape for layer in layers]
    return _rows("layer", [{"rows": rows, "columns": columns} for rows, columns in shapes])


def _tables(hidden: tuple[FixedLayer, ...], output: FixedLayer, shift: int) -> Iterator[np.ndarray]:
    """Weights in the order of the kernels and biases, padded; ``shift`` 0: no half is folded in."""
    for layer in padded_layers(hidden, output, shift):
        yield _words(layer.weights)
        yield layer.bias.astype("<i8")


def _numbers(part: Input, size: int) -> list[tuple[int, Rescale]]:
    """Source and scale of each input of a field; of a rotation, the first number of its source."""
    sources = part.sources if part.kind != ROTATION else part.sources[:1] * size
    rescales = [own or ZERO for own in part.rescales] or [ZERO] * size
    return list(zip(sources, rescales, strict=True))


def _axes(race: RaceTables, gate: int) -> np.ndarray:
    """Directions through a gate, to its right and down, (3, 3) Q30 in the world."""
    if race.axes is not None:
        return race.axes[gate]
    cosine, sine = race.gate_cos[gate], race.gate_sin[gate]
    return np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, ONE]], np.int64)


def _estimator(tables: EstimatorTables) -> Iterator[np.ndarray]:
    model = np.concatenate([tables.model, tables.differentiated])
    terms = [(c, m) for c, m in np.ndindex(*model.shape) if model[c, m]]
    nets = [net for net in (tables.thrust, tables.moment) if net is not None]
    counts = [len(net.hidden) + 1 for net in nets] or [0, 0]
    rpm = tables.rpm_input or Rescale(0, 0, 0)
    shifts = [shift for net in nets for shift in net.shifts] or [0] * 4
    yield _rows("estimator", [{
        "period_ns": round(1e9 / tables.sample_rate), "exponents": tables.exponents,
        "channels": tables.channel_exponents, "terms": len(terms),
        "thrust_layers": counts[0], "moment_layers": counts[1], "rpm_middle": rpm.middle,
        "rpm_factor": rpm.factor, "rpm_shift": rpm.shift, "thrust_shift": shifts[0],
        "moment_shift": shifts[1:], "a1": tables.a1, "a2": tables.a2, "gain": tables.gain,
    }])  # fmt: skip
    yield _rows("term", [
        {"channel": c, "monomial": m, "factor": model[c, m]} for c, m in terms
    ])  # fmt: skip
    for net in nets:
        yield _sizes((*net.hidden, net.output))
    for net in nets:
        yield from _tables(net.hidden, net.output, 0)


def _battery(tables: BatteryTables) -> np.ndarray:
    factors = {name: getattr(tables, name) for name in ("low_pass", "lead", "gain")}
    return _rows("battery", [{
        "period_ns": round(1e9 / tables.sample_rate), "exponent": tables.exponent,
        **{name: factor.value for name, factor in factors.items()},
        **{f"{name}_shift": factor.shift for name, factor in factors.items()},
        "lowest": tables.lowest, "highest": tables.highest, "first": tables.first,
    }])  # fmt: skip


def _case_words(policy: FixedPolicy) -> Iterator[np.ndarray]:
    cases = policy.cases
    traces, targets = cases.traces[:, None], cases.targets[:, None]
    for rows in (
        (cases.inputs, cases.commands, traces),
        (cases.states, targets, cases.observed, cases.status),
        (cases.measurements,),
        (cases.estimates,),
        (cases.samples,),
        (cases.digests,),
    ):
        yield np.concatenate([np.asarray(x).astype(np.int64) for x in rows], axis=-1).astype("<u4")


# ---- reading -------------------------------------------------------------------------------------


class Reader:
    """Takes words from the beginning on."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, dtype: np.dtype | str, count: int) -> np.ndarray:
        """The next numbers or structures, (count,).

        Raises:
            InputError: there are fewer.
        """
        size = np.dtype(dtype).itemsize * int(count)
        if count < 0 or self._at + size > len(self._data):
            raise InputError("its sizes are not those of its header")
        self._at += size
        return np.frombuffer(self._data[self._at - size : self._at], dtype)

    def rows(self, name: str, count: int) -> np.ndarray:
        """The next structures of ``STRUCTS``."""
        return self.take(STRUCTS[name], count)

    def end(self) -> None:
        """Raise an ``InputError`` if words are left."""
        if self._at != len(self._data):
            raise InputError("its sizes are not those of its header")


def read_words(data: bytes) -> FixedPolicy:
    """The policy of words whose checksum is right; no other check than that of sizes."""
    words = Reader(data[:-4])
    header = words.rows("header", 1)[0]
    vehicle, name = _string(header["vehicle"]), _string(header["name"])
    if vehicle not in MODELS:
        raise InputError(f"vehicle model {vehicle!r}, allowed: {', '.join(MODELS)}")
    inputs, size, gates = (int(header[key]) for key in ("inputs", "state_size", "gates"))
    shapes = words.rows("layer", header["layers"])
    fields = words.rows("field", header["fields"])
    exponents = words.take("<i4", size).astype(np.int64)
    parts, numbers = words.rows("part", header["parts"]), words.rows("input", inputs)
    columns = STRUCTS["gate"].itemsize // 4 + int(header["constants"])
    track = words.take("<i4", gates * columns).reshape(gates, columns)
    box = _box(parts, vehicle)
    race = RaceTables(
        box=box,
        fields=_state(fields, exponents),
        inputs=tuple(_input(part, numbers) for part in parts),
        world_box=bool(header["world_box"]),
        time_step=float(header["period_ns"] / 1e9),
        **_track(track),
    )
    hidden, output = _layers(words, shapes)
    network = FixedNetwork(
        box=box,
        hidden=hidden,
        output=output,
        output_shift=int(header["output_shift"]),
        fraction_bits=int(header["fraction_bits"]),
        command_low=header["low"].astype(np.int64),
        command_high=header["high"].astype(np.int64),
        model=MODELS[vehicle],
    )
    estimator = _read_estimator(words) if header["estimator"] else None
    battery = _read_battery(words.rows("battery", 1)[0]) if header["battery"] else None
    cases = _read_cases(words, header)
    words.end()
    source = header["source"].astype("<u4").tobytes().hex()
    return FixedPolicy(name, network, race, estimator, battery, source, race.time_step, cases)


def _string(words: np.ndarray) -> str:
    return words.astype("<u4").tobytes().partition(b"\0")[0].decode("ascii", "replace")


def _state(fields: np.ndarray, exponents: np.ndarray) -> tuple[StateField, ...]:
    found = []
    for code, start, size in fields.tolist():
        if not 1 <= code <= len(STATE_FIELDS):
            raise InputError(f"field {code} of its state, allowed: 1 to {len(STATE_FIELDS)}")
        name, own = STATE_FIELDS[code - 1], tuple(exponents[start : start + size].tolist())
        found.append(StateField(name, NOTES.get(name, "actuators"), start, own))
    return tuple(found)


def _box(parts: np.ndarray, vehicle: str) -> InputBox:
    """The declared ranges, by field."""
    units = {field.name: (field.unit, field.frame) for field in fields_of(MODELS[vehicle]).values()}
    fields, scaled, exponent = [], [], {}
    for part in parts:
        name, kind = _string(part["name"]), int(part["kind"])
        if not 1 <= kind <= len(KINDS):
            raise InputError(f"kind {kind} of its inputs, allowed: 1 to {len(KINDS)}")
        exponent[name] = int(part["exponent"])
        unit, frame = units.get(split_name(name)[0], ("", ""))
        fields.append(Field(name, int(part["size"]), unit, frame, 2.0 ** exponent[name]))
        scaled += [split_name(name)[0]] if KINDS[kind - 1] == SCALED else []
    return InputBox(Layout(tuple(fields)), exponent, tuple(scaled))


def _input(part: np.ndarray, numbers: np.ndarray) -> Input:
    """How a field of the observation is computed."""
    kind, index, size = KINDS[part["kind"] - 1], int(part["index"]), int(part["size"])
    rows = [row.tolist() for row in numbers[index : index + size]] if index >= 0 else []
    if not rows or len(rows) != size:
        raise InputError(f"{size} inputs from number {index} on, of {len(numbers)}")
    sources = [row[0] for row in rows]
    if kind in (POSITION, VELOCITY, ATTITUDE, ROTATION):
        sources = [sources[0] + i for i in range(4 if kind == ROTATION else 3)]
    found = [Rescale(*row[1:]) for row in rows] if kind == SCALED else []
    rescales = tuple(None if own == ZERO else own for own in found)
    name = _string(part["name"])
    return Input(name, kind, index, tuple(sources), rescales, int(part["lag"]))


def _track(track: np.ndarray) -> dict[str, np.ndarray]:
    """The fields of ``RaceTables`` about the gates."""
    size = STRUCTS["gate"].itemsize // 4
    gates = np.ascontiguousarray(track[:, :size]).view(STRUCTS["gate"])[:, 0]
    wide = {name: gates[name].astype(np.int64) for name in gates.dtype.names}
    return {
        "gate_position": wide["position"],
        "gate_cos": wide["cosine"],
        "gate_sin": wide["sine"],
        "gate_yaw": wide["yaw"],
        "half_size": np.stack([wide["half_width"], wide["half_height"]], axis=1),
        "next_gate": track[:, size:].astype(np.int64),
        "axes": wide["axes"].reshape(-1, 3, 3),
        "circle": gates["round"] != 0,
    }


def _layers(words: Reader, shapes: np.ndarray) -> tuple[tuple[FixedLayer, ...], FixedLayer]:
    """Hidden layers and the output layer, without their padding."""
    found = []
    for number, (rows, columns) in enumerate(shapes.tolist(), start=1):
        if rows < 1 or columns < 1:
            raise InputError(f"layer {number - 1}: {rows} rows of {columns}, allowed: above 0")
        multiple = BLOCK if number == len(shapes) else TURN
        height, width = -(-rows // multiple) * multiple, -(-columns // TURN) * TURN
        blocks = words.take("<i4", height * width).reshape(-1, width, BLOCK)
        weights = blocks.transpose(0, 2, 1).reshape(height, width)[:rows, :columns]
        bias = words.take("<i8", height)[:rows]
        found.append(
            FixedLayer(weights.astype(np.int32), bias.astype(np.int64), np.full(rows, np.nan))
        )
    return tuple(found[:-1]), found[-1]


def _read_estimator(words: Reader) -> EstimatorTables:
    own = words.rows("estimator", 1)[0]
    terms = words.rows("term", own["terms"])
    counts = [int(own["thrust_layers"]), int(own["moment_layers"])]
    shapes = [words.rows("layer", count) for count in counts]
    shifts = [(int(own["thrust_shift"]),), tuple(own["moment_shift"].tolist())]
    nets = [
        FixedResidual(*_layers(words, shape), shift)
        for shape, shift in zip(shapes, shifts, strict=True)
        if len(shape)
    ]
    if len(nets) == 1:
        raise InputError("its estimator has one residual network, allowed: none or two")
    model = np.zeros((len(CHANNELS) + 3, len(MONOMIALS)), np.int64)
    model[terms["channel"], terms["monomial"]] = terms["factor"]
    rpm = Rescale(*(int(own[f"rpm_{key}"]) for key in ("middle", "factor", "shift")))
    return EstimatorTables(
        sample_rate=1e9 / int(own["period_ns"]),
        cutoff=0.0,
        exponents=tuple(own["exponents"].tolist()),
        channel_exponents=tuple(own["channels"].tolist()),
        model=model[: len(CHANNELS)],
        differentiated=model[len(CHANNELS) :],
        a1=int(own["a1"]),
        a2=int(own["a2"]),
        gain=int(own["gain"]),
        rpm_input=rpm if nets else None,
        thrust=nets[0] if nets else None,
        moment=nets[1] if nets else None,
    )


def _read_battery(own: np.ndarray) -> BatteryTables:
    low_pass, lead, gain = (
        Factor(int(own[name]), int(own[f"{name}_shift"])) for name in ("low_pass", "lead", "gain")
    )
    ends = (int(own[name]) for name in ("lowest", "highest", "first"))
    rate = 1e9 / int(own["period_ns"])
    return BatteryTables(rate, int(own["exponent"]), low_pass, lead, gain, *ends)


def _read_cases(words: Reader, header: np.ndarray) -> Cases:
    inputs, size = int(header["inputs"]), int(header["state_size"])
    count, width = int(header["network_tests"]), inputs + COMMANDS + 1
    network = words.take("<i4", count * width).reshape(count, width)
    count, width = int(header["race_tests"]), size + 1 + inputs + 3
    race = words.take("<u4", count * width).reshape(count, width)
    samples = SAMPLES if header["estimator"] else 0
    measured = words.take("<u4", MEASUREMENTS * 13 if samples else 0).reshape(-1, 13)
    estimates = words.take("<u4", samples * len(CHANNELS)).reshape(-1, len(CHANNELS))
    rows = MEASUREMENTS if header["battery"] else 0
    return Cases(
        inputs=network[:, :inputs],
        commands=network[:, inputs:-1],
        traces=network[:, -1].view("<u4"),
        states=race[:, :size],
        targets=race[:, size].astype(np.int64),
        observed=race[:, size + 1 : size + 1 + inputs].view("<i4"),
        status=race[:, size + 1 + inputs :],
        history_digest=int(header["history_digest"]),
        measurements=measured,
        estimates=estimates,
        samples=words.take("<u4", rows * 2 * MOTORS).reshape(-1, 2 * MOTORS),
        digests=words.take("<u4", SAMPLES if rows else 0),
    )


# ---- version 1 -----------------------------------------------------------------------------------


def upgraded(data: bytes) -> bytes:
    """The words of version 1 of the format, whose hash is right, as words of this version."""
    old = np.frombuffer(data[:-32], "<i4")
    inputs, layers, state, fields, parts = (int(old[i]) for i in (3, 5, 6, 7, 8))
    header = np.zeros(1, HEADER)
    first = header.view("<i4")
    first[:4], first[4:17] = old[:4], old[5:18]  # without the number of commands
    header["version"], header["history_digest"] = VERSION, DIGEST_START
    header["bytes"] = 0
    first[20:40] = old[18:38]  # hash, name and vehicle; then the places of the rotors
    first[40:48] = old[42:50]
    if old[4] != COMMANDS or not np.array_equal(old[38:42], np.arange(COMMANDS)):
        raise InputError("other than four commands, or rotors in another order")
    ends = np.cumsum([50, 5 * layers, 3 * fields + state, 10 * parts, 4 * inputs])
    certificates = old[ends[0] : ends[1]].reshape(layers, 5)[:, :2]
    observed = old[ends[2] : ends[3]].reshape(parts, 10)
    observed = np.insert(observed, 4, 0, axis=1)  # without a lag
    pieces = (first, certificates, old[ends[1] : ends[2]], observed, old[ends[3] :])
    body = bytearray(b"".join(np.ascontiguousarray(piece, "<i4").tobytes() for piece in pieces))
    place = HEADER.fields["bytes"][1]
    body[place : place + 4] = np.uint32(len(body) + 4).tobytes()
    return bytes(body) + np.uint32(zlib.crc32(body)).tobytes()


if __name__ == "__main__":
    from pathlib import Path

    (Path(__file__).parent / "runtime" / "qj_words.h").write_text(layout_header())
