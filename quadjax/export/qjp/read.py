"""Reads a ``.qjp`` file; rejects whatever the writer does not write."""

import hashlib
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError, reading
from quadjax.core.files import check_file
from quadjax.export import emulator, race_emulator
from quadjax.export.fixed import FixedLayer, FixedNetwork
from quadjax.export.qjp.policy import (
    FIELD_BYTES,
    HASH_BYTES,
    KINDS,
    MAGIC,
    NAME_BYTES,
    NO_RESCALE,
    OUTPUTS,
    STATE_FIELDS,
    VEHICLE_BYTES,
    VERSION,
    NetworkCases,
    QjpPolicy,
    RaceCases,
    qjp_bytes,
)
from quadjax.export.qjp.words import Reader
from quadjax.export.race_tables import NOTES, ROTATION, SCALED, Input, RaceTables, StateField
from quadjax.export.ranges import InputBox
from quadjax.export.scaling import Rescale
from quadjax.export.selftest import BLOCK, TURN
from quadjax.race.layout import Field, Layout
from quadjax.race.observations import fields_of
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.registry import MODELS

MOST_BYTES = 2**24
HEADER_BYTES = 4 * 50
GATE_WORDS = 19  # and the inputs that depend on the gate alone
QUATERNION = 4  # numbers of the source of a rotation


def read_qjp(path: Path | str) -> QjpPolicy:
    """Read a ``.qjp`` file; check its hash, its range proof, its self-tests and its layout.

    Raises:
        InputError: no such file, not a .qjp, damaged, of another version, or one of which the
            range proof or a self-test fails.
    """
    check_file(path)
    with reading(path), open(path, "rb") as stream:
        data = stream.read(MOST_BYTES + 1)
    try:
        return parse_qjp(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def parse_qjp(data: bytes) -> QjpPolicy:
    """As ``read_qjp``, of the bytes of a file."""
    _check_header(data)
    try:
        with np.errstate(all="ignore"):
            own = _read(Reader(data[:-HASH_BYTES]))
            same = qjp_bytes(own) == data
            right = same and _passes(own)
    except InputError:
        raise
    except (ValueError, IndexError, KeyError, OverflowError) as error:
        raise InputError(f"not what a .qjp file contains ({error!s:.100})") from None
    if not same:
        raise InputError("its certificate, padding or layout is not what the converter writes")
    if not right:
        raise InputError("its self-tests give other integers")
    return own


def _check_header(data: bytes) -> None:
    """Magic, version, size and hash."""
    if len(data) < HEADER_BYTES + HASH_BYTES or len(data) % 4:
        raise InputError(f"{len(data)} bytes, which no .qjp file has")
    magic, version, size = (int(x) for x in np.frombuffer(data[:12], "<u4"))
    if magic != MAGIC:
        raise InputError("not a .qjp file")
    if version != VERSION:
        raise InputError(f"version {version} of the format, allowed: {VERSION}")
    if size != len(data):
        raise InputError(f"{len(data)} bytes, its header says {size}")
    if hashlib.sha256(data[:-HASH_BYTES]).digest() != data[-HASH_BYTES:]:
        raise InputError("changed since it was written: its SHA-256 differs")


def _read(words: Reader) -> QjpPolicy:
    words.take(3)
    inputs, outputs, layers, state_size, fields, parts, gates = words.take(7)
    constants, world_box, _, shift, fraction, period, network_tests, race_tests = words.take(8)
    policy_hash = words.take(8).astype("<i4").tobytes().hex()
    name, vehicle = words.text(NAME_BYTES), words.text(VEHICLE_BYTES)
    words.take(OUTPUTS)  # places of the rotors
    low, high = words.take(OUTPUTS), words.take(OUTPUTS)
    _check_numbers(vehicle, outputs, shift, fraction, low, high)
    if period < 1:
        raise InputError(f"its time step is {period} ns, allowed: above 0")
    sizes = [words.take(5)[:2] for _ in range(layers)]
    state = _state(words, fields, state_size)
    records = [(words.take(4), words.text(FIELD_BYTES)) for _ in range(parts)]
    numbers = words.take(4 * inputs).reshape(inputs, 4)
    box = _box(records, MODELS[vehicle])
    race = _race(words, box, state, (records, numbers), (gates, constants), bool(world_box))
    tables = [_layer(words, size, i + 1 == layers) for i, size in enumerate(sizes)]
    network = FixedNetwork(
        box=box,
        hidden=tuple(tables[:-1]),
        output=tables[-1],
        output_shift=int(shift),
        fraction_bits=int(fraction),
        command_low=low,
        command_high=high,
        model=MODELS[vehicle],
    )
    tests = words.take(network_tests * (inputs + OUTPUTS + 1)).reshape(network_tests, -1)
    seen = words.take(race_tests * (state_size + 1 + inputs + 3)).reshape(race_tests, -1)
    words.end()
    return QjpPolicy(
        name=name,
        network=network,
        race=race,
        policy_hash=policy_hash,
        time_step=float(period / 1e9),
        network_test=_network_test(tests, int(inputs)),
        race_test=_race_test(seen, int(state_size), int(inputs)),
    )


def _check_numbers(
    vehicle: str, outputs: int, shift: int, fraction: int, low: np.ndarray, high: np.ndarray
) -> None:
    """Raise an ``InputError`` for a header that no writer writes."""
    if vehicle not in MODELS:
        raise InputError(f"vehicle model {vehicle!r}, allowed: {', '.join(MODELS)}")
    fine = outputs == OUTPUTS and 1 <= shift <= 32 and 0 <= fraction <= 30
    if not fine or np.any(low > high) or np.any(low == -(2**31)):
        raise InputError("a number of its header is not allowed")


def _state(words: Reader, fields: int, size: int) -> tuple[StateField, ...]:
    """The fields of the state."""
    records = words.take(3 * fields).reshape(-1, 3).tolist()
    exponents = words.take(size).tolist()
    names = [STATE_FIELDS[code - 1] for code, _, _ in records]
    found = zip(names, records, strict=True)
    return tuple(
        StateField(name, NOTES.get(name, "actuators"), at, tuple(exponents[at : at + count]))
        for name, (_, at, count) in found
    )


def _box(records: list[tuple[np.ndarray, str]], model: VehicleModel) -> InputBox:
    """The declared ranges, by field."""
    units = {field.name: (field.unit, field.frame) for field in fields_of(model).values()}
    fields, scaled = [], []
    for (kind, _, size, exponent), name in records:
        unit, frame = units.get(name, ("", ""))
        fields.append(Field(name, int(size), unit, frame, 2.0**exponent))
        scaled += [name] if KINDS[kind - 1] == SCALED else []
    exponents = {name: int(record[3]) for record, name in records}
    return InputBox(Layout(tuple(fields)), exponents, tuple(scaled))


def _race(
    words: Reader,
    box: InputBox,
    state: tuple[StateField, ...],
    observed: tuple[list[tuple[np.ndarray, str]], np.ndarray],
    sizes: tuple[int, int],
    world_box: bool,
) -> RaceTables:
    """Observation and track, from the words of the gates on."""
    records, numbers = observed
    gates, constants = sizes
    size = GATE_WORDS + constants
    track = words.take(gates * size).reshape(gates, size)
    yaw = (track[:, 18] << 32) | (track[:, 17] & 0xFFFFFFFF)
    if np.any(track[:, 14:16] < 0):
        raise InputError("an opening of its gates has a negative size")
    return RaceTables(
        box=box,
        fields=state,
        inputs=tuple(_input(record, name, numbers) for record, name in records),
        gate_position=track[:, :3],
        gate_cos=track[:, 12],
        gate_sin=track[:, 13],
        gate_yaw=yaw,
        half_size=track[:, 14:16],
        next_gate=track[:, GATE_WORDS:],
        world_box=world_box,
        axes=track[:, 3:12].reshape(gates, 3, 3),
        circle=track[:, 16] != 0,
    )


def _input(record: np.ndarray, name: str, numbers: np.ndarray) -> Input:
    """How a field of the observation is computed."""
    code, index, size, _ = record.tolist()
    rows, kind = numbers[index : index + size].tolist(), KINDS[code - 1]
    sources = [row[0] for row in rows]
    if kind == ROTATION:
        sources = [sources[0] + i for i in range(QUATERNION)]
    found = [Rescale(*row[1:]) for row in rows] if kind == SCALED else []
    rescales = tuple(None if own == NO_RESCALE else own for own in found)
    return Input(name, kind, index, tuple(sources), rescales)


def _layer(words: Reader, size: np.ndarray, last: bool) -> FixedLayer:
    """The tables of a layer, without their padding."""
    rows, columns = (int(x) for x in size)
    multiple = BLOCK if last else TURN
    padded_rows, padded_columns = -(-rows // multiple) * multiple, -(-columns // TURN) * TURN
    blocks = words.take(padded_rows * padded_columns).reshape(-1, padded_columns, BLOCK)
    weights = blocks.transpose(0, 2, 1).reshape(padded_rows, padded_columns)[:rows, :columns]
    bias = words.longs(padded_rows)[:rows]
    return FixedLayer(weights.astype(np.int32), bias, np.full(rows, np.nan))


def _network_test(words: np.ndarray, inputs: int) -> NetworkCases:
    """The self-test of the network that the file states."""
    commands = words[:, inputs : inputs + OUTPUTS].astype(np.int32)
    return NetworkCases(words[:, :inputs].astype(np.int32), commands, words[:, -1].astype("u4"))


def _race_test(words: np.ndarray, state_size: int, inputs: int) -> RaceCases:
    """The self-test of the observation that the file states."""
    start = state_size + 1
    return RaceCases(
        states=words[:, :state_size].astype(np.uint32),
        targets=words[:, state_size],
        inputs=words[:, start : start + inputs].astype(np.int32),
        status=words[:, start + inputs :].astype(np.uint32),
    )


def _passes(policy: QjpPolicy) -> bool:
    """Whether the emulators give the integers of the self-tests."""
    tests, seen = policy.network_test, policy.race_test
    commands, trace = emulator.forward_traced(policy.network, tests.inputs)
    states = np.ascontiguousarray(seen.states).view(np.float32)
    observed = race_emulator.observe(policy.race, states, seen.targets)
    status = np.stack([observed.clipped, observed.nan, observed.outside], axis=1)
    return (
        np.array_equal(commands, tests.commands)
        and np.array_equal(emulator.trace_digest(trace), tests.traces)
        and np.array_equal(observed.q, seen.inputs)
        and np.array_equal(status, seen.status)
    )
