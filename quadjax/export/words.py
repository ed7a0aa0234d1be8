"""The words of a policy: what the C runtime runs, and the bytes of a ``.qjp`` file.

``STRUCTS`` names every word: ``pack`` and ``read.unpack`` use it, and ``runtime/qj_words.h`` is
generated from it. The words have 32 bits, little-endian, and follow each other:

- ``header``: counts, kind of commands, limits, hash of the policy, names;
- for each layer, ``layer``: rows, columns;
- the state: for each field, ``field``: code (``qj_field`` in ``qj.h``), first number, size; then
  for each number the exponent e of its range 2^e;
- the observation: for each field, ``part``: kind (1 position, 2 velocity, 3 attitude, 4 rotation,
  5 copied, 6 scaled, 7 of the gate), first input, size, exponent, name; then for each input,
  ``input``: source, middle, factor, shift;
- for each gate, ``gate``: position, axes, cosine, sine, size, round, yaw; and constants;
- weights and biases of each layer, in blocks of four rows: the four weights of column 0, of column
  1, and so on; columns, and rows of hidden layers, are padded with zeros to a multiple of 8;
- ``estimator`` of disturbances and ``battery``, of the highest rpm, if the header says so;
- ``noise``, in version 5, for policies that sample their actions;
- self-tests: inputs and commands, states and inputs, samples of the estimators;
- a CRC-32 of everything before it.

Names are ASCII with a zero at the end. Numbers of 64 bits are two words, the low one first. The
loader accepts words only if the checksum matches, every count and number is allowed, no sum reaches
2^63 - 2^30, no hidden output exceeds 2^30 - 1, padding is zero, and every self-test gives the
stated integers; ``qj_load`` returns what is wrong as a number (``qj_error``).
"""

import dataclasses
import zlib
from collections.abc import Iterator
from typing import get_args

import numpy as np

from quadjax.core.errors import InputError
from quadjax.export.battery import MOTORS
from quadjax.export.cases import MEASUREMENTS, SAMPLES, Cases, Tables
from quadjax.export.disturbances import CHANNELS, FINE_BITS, MONOMIALS, EstimatorTables
from quadjax.export.integers import WORD
from quadjax.export.names import LONGEST_NAME
from quadjax.export.network import FixedLayer
from quadjax.export.noise import NoiseTables
from quadjax.export.race_tables import (
    NUMBER,
    QUATERNION_EXPONENT,
    TRACK,
    YAW_EXPONENT,
    Kind,
    RaceTables,
)
from quadjax.export.targets import COMMAND_KINDS, RATES, STATE_FIELDS

MAGIC, VERSION, COMMANDS = 0x00504A51, 4, 4
SAMPLED_VERSION = 5  # of words with the section ``noise``
NAME_BYTES, FIELD_BYTES = LONGEST_NAME + 1, 24
BLOCK = 4  # rows of a block of weights
TURN = 8  # columns, and rows of a hidden layer, are padded to a multiple of this
KINDS = get_args(Kind)  # numbered from 1 on
LARGEST_SHIFT, LARGEST_EXPONENT = 60, 30


def _struct(*fields: str | tuple[str, str] | tuple[str, str, int]) -> np.dtype:
    """Words by name; one int32 unless a type, and a count, are given."""
    return np.dtype([(field, "<i4") if isinstance(field, str) else field for field in fields])


def _places(struct: np.dtype) -> dict[str, int]:
    """Byte of the start of each field."""
    return {name: entry[1] for name, entry in (struct.fields or {}).items()}


STRUCTS = {
    "header": _struct(
        *("magic", "version", "bytes", "inputs", "layers", "state_size", "fields", "parts"),
        *("gates", "constants", "world_box", "kind", "output_shift", "fraction_bits"),
        *("period_ns", "network_tests", "race_tests"),
        *("estimator", "battery", ("source", "<u4", 8), ("name", "<u4", NAME_BYTES // 4)),
        *(("vehicle", "<u4", 4), ("low", "<i4", COMMANDS), ("high", "<i4", COMMANDS)),
    ),
    "layer": _struct("rows", "columns"),
    "field": _struct("code", "start", "size"),
    "part": _struct("kind", "index", "size", "exponent", ("name", "<u4", FIELD_BYTES // 4)),
    "input": NUMBER,
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
    "noise": _struct(("factor", "<i4", COMMANDS), "on_clamped", ("digest", "<u4")),
}
HEADER = STRUCTS["header"]
BYTES_AT = _places(HEADER)["bytes"]


@dataclasses.dataclass(frozen=True)
class FixedPolicy(Tables):
    """A policy as integers: what the words contain."""

    name: str  # of the table in C
    policy_hash: str  # SHA-256 of the policy file
    cases: Cases
    noise: NoiseTables | None = None  # of a policy that samples its actions

    @property
    def actions(self) -> str:
        """How its actions are chosen, as text."""
        return "deterministic (mean)" if self.noise is None else "sampled"

    @property
    def version(self) -> int:
        """Version of the format of its words."""
        return VERSION if self.noise is None else SAMPLED_VERSION


def case_groups(inputs: int, state_size: int) -> tuple[dict[str, int], ...]:
    """The arrays of ``Cases`` that share their rows, with their columns, in the order of words."""
    return (
        {"inputs": inputs, "commands": COMMANDS, "traces": 1},
        {"states": state_size, "targets": 1, "observed": inputs, "status": 3},
        {"measurements": 13},
        {"estimates": len(CHANNELS)},
        {"samples": 2 * MOTORS},
        {"digests": 1},
    )


def layout_header() -> str:
    """``runtime/qj_words.h``: the place of every word in its structure."""
    values = {"magic": MAGIC, "version": VERSION, "sampled_version": SAMPLED_VERSION}
    values |= {"yaw_exponent": YAW_EXPONENT}
    values |= {"quaternion_exponent": QUATERNION_EXPONENT, "fine_bits": FINE_BITS}
    values |= {"battery_bits": 40, "test_rows": MEASUREMENTS, "test_samples": SAMPLES}
    values |= {"measurements": 13, "monomials": len(MONOMIALS), "channels": len(CHANNELS)}
    values |= {f"see_{kind}": number for number, kind in enumerate(KINDS, start=1)}
    for name, struct in STRUCTS.items():
        places = {f"{name}_{field}": at // 4 for field, at in _places(struct).items()}
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
    shifts = np.concatenate([part.numbers["shift"] for part in policy.race.inputs])
    if not np.all((shifts >= 1) & (shifts <= LARGEST_SHIFT)):
        raise InputError(f"allowed: scales of 2^-1 to 2^-{LARGEST_SHIFT}")
    data = bytearray(b"".join(part.tobytes() for part in _parts(policy)))
    data[BYTES_AT : BYTES_AT + 4] = np.uint32(len(data) + 4).tobytes()
    return bytes(data) + np.uint32(zlib.crc32(data)).tobytes()


def _text(data: str, size: int) -> np.ndarray:
    padded = data.encode("ascii", "replace")[: size - 1].ljust(size, b"\0")
    return np.frombuffer(padded, "<u4")


def _words(values: object, dtype: str = "<i4") -> np.ndarray:
    """Integers as words.

    Raises:
        InputError: one that does not fit.
    """
    numbers, limits = np.asarray(values).astype(np.int64), np.iinfo(dtype)
    if np.any((numbers < limits.min) | (numbers > limits.max)):
        raise InputError("a number of the policy does not fit in its word of a .qjp")
    return numbers.astype(dtype)


def _rows(name: str, count: int = 1, /, **columns: object) -> np.ndarray:
    """Structures of ``STRUCTS`` from their fields, each of ``count`` rows."""
    rows = np.zeros(count, STRUCTS[name])
    for field, values in columns.items():
        words = _words(values, STRUCTS[name][field].base.str)
        rows[field] = words.reshape(rows[field].shape)
    return rows


def _parts(policy: FixedPolicy) -> Iterator[np.ndarray]:
    """All words but the checksum, in their order."""
    network, race, cases = policy.network, policy.race, policy.cases
    yield _rows(
        "header",
        magic=MAGIC,
        version=policy.version,
        inputs=network.inputs,
        layers=len(network.layers),
        state_size=race.state_size,
        fields=len(race.fields),
        parts=len(race.inputs),
        gates=race.gates,
        constants=race.next_gate.shape[1],
        world_box=race.world_box,
        kind=COMMAND_KINDS.get(network.model.commands[0].name, RATES),
        output_shift=network.output_shift,
        fraction_bits=network.fraction_bits,
        period_ns=round(race.time_step * 1e9),
        network_tests=len(cases.inputs),
        race_tests=len(cases.states),
        estimator=policy.estimator is not None,
        battery=policy.battery is not None,
        source=np.frombuffer(bytes.fromhex(policy.policy_hash), "<u4"),
        name=_text(policy.name, NAME_BYTES),
        vehicle=_text(network.model.name, 16),
        low=network.command_low,
        high=network.command_high,
    )
    yield _sizes(network.layers)
    yield from _observation(race)
    yield _track(race)
    yield from _tables(network.layers, network.output_shift)
    if policy.estimator is not None:
        yield from _estimator(policy.estimator)
    if policy.battery is not None:
        yield _rows("battery", **vars(policy.battery))
    if (noise := policy.noise) is not None:
        about = {"on_clamped": noise.on_clamped, "digest": noise.digest}
        yield _rows("noise", factor=noise.factors, **about)
    for group in case_groups(network.inputs, race.state_size):
        yield np.concatenate([getattr(cases, name) for name in group], axis=1)


def _sizes(layers: tuple[FixedLayer, ...]) -> np.ndarray:
    rows, columns = zip(*(layer.weights.shape for layer in layers), strict=True)
    return _rows("layer", len(layers), rows=rows, columns=columns)


def _observation(race: RaceTables) -> Iterator[np.ndarray]:
    """Fields and ranges of the state; fields of the observation, and their numbers."""
    codes = [1 + STATE_FIELDS.index(name) for name in race.fields]
    sizes = [len(exponents) for exponents in race.fields.values()]
    yield _rows("field", len(codes), code=codes, start=list(race.starts.values()), size=sizes)
    yield _words(race.exponents)
    parts = race.inputs
    yield _rows(
        "part",
        len(parts),
        kind=[1 + KINDS.index(part.kind) for part in parts],
        index=[part.index for part in parts],
        size=[len(part.numbers) for part in parts],
        exponent=[race.box.exponent[part.name] for part in parts],
        name=[_text(part.name, FIELD_BYTES) for part in parts],
    )
    yield from (part.numbers for part in parts)


def _track(race: RaceTables) -> np.ndarray:
    """Rows (gates, words) of each gate, and of the inputs that depend on it alone."""
    gates = _rows("gate", race.gates, **{name: race.track[name] for name in TRACK.names or ()})
    words = gates.view("<i4").reshape(race.gates, -1)
    return np.concatenate([words, _words(race.next_gate).reshape(race.gates, -1)], axis=1)


def _tables(layers: tuple[FixedLayer, ...], output_shift: int) -> Iterator[np.ndarray]:
    """Weights in the order of the kernels and biases, padded; padded rows hold the rounding half.

    An ``output_shift`` of 0: no half is folded into the biases of the output.
    """
    for layer in layers:
        hidden, (rows, columns) = layer is not layers[-1], layer.weights.shape
        height, width = padded(rows, columns, hidden)
        shift = WORD if hidden else output_shift
        weights = np.zeros((height, width), np.int64)
        weights[:rows, :columns] = layer.weights
        bias = np.full(height, 2 ** (shift - 1) if shift else 0, "<i8")
        bias[:rows] = layer.bias
        yield _words(weights.reshape(-1, BLOCK, width).transpose(0, 2, 1))
        yield bias


def padded(rows: int, columns: int, hidden: bool) -> tuple[int, int]:
    """The shape of a layer's table in the words."""
    multiple = TURN if hidden else BLOCK
    return -(-rows // multiple) * multiple, -(-columns // TURN) * TURN


def _estimator(tables: EstimatorTables) -> Iterator[np.ndarray]:
    channels, terms = np.nonzero(tables.model)
    residual, numbers = tables.residual, dict[str, object]()
    if residual is not None:
        numbers = {f"rpm_{name}": value for name, value in vars(residual.rpm).items()}
        numbers |= {"thrust_layers": len(residual.thrust), "moment_layers": len(residual.moment)}
        numbers |= {"thrust_shift": residual.shifts[0], "moment_shift": residual.shifts[1:]}
    yield _rows(
        "estimator",
        period_ns=tables.period_ns,
        exponents=tables.exponents,
        channels=tables.channel_exponents,
        terms=len(terms),
        a1=tables.a1,
        a2=tables.a2,
        gain=tables.gain,
        **numbers,
    )
    factors = tables.model[channels, terms]
    yield _rows("term", len(terms), channel=channels, monomial=terms, factor=factors)
    if residual is not None:
        yield _sizes((*residual.thrust, *residual.moment))
        yield from _tables(residual.thrust, 0)
        yield from _tables(residual.moment, 0)


if __name__ == "__main__":
    from pathlib import Path

    (Path(__file__).parent / "runtime" / "qj_words.h").write_text(layout_header())
