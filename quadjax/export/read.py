"""Reads a ``.qjp`` file; rejects whatever the writer does not write and the C does not load."""

import hashlib
import zlib
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError, reading
from quadjax.core.files import check_file
from quadjax.export import cases
from quadjax.export.battery_tables import prove_battery
from quadjax.export.estimator_tables import EstimatorTables, prove_terms
from quadjax.export.fixed import FixedLayer, FixedNetwork
from quadjax.export.integers import INPUT_BITS, ONE, WORD
from quadjax.export.proof import prove_layer
from quadjax.export.race_tables import (
    ATTITUDE,
    COPY,
    GATE,
    POSITION,
    QUATERNION_EXPONENT,
    ROTATION,
    SCALED,
    VELOCITY,
    YAW_EXPONENT,
    Input,
    RaceTables,
)
from quadjax.export.words import (
    HEADER,
    LARGEST_EXPONENT,
    LARGEST_SHIFT,
    MAGIC,
    SIZES,
    VERSION,
    FixedPolicy,
    pack,
    read_words,
    upgraded,
)

MOST_BYTES = 2**24
LARGEST_LAG, LARGEST_YAW = 4096, 2**36
VECTORS = {POSITION: "position", VELOCITY: "velocity", ATTITUDE: "euler", ROTATION: "quaternion"}


def read_qjp(path: Path | str) -> FixedPolicy:
    """Read a ``.qjp`` file of this or the first version of the format, and check it.

    Raises:
        InputError: no such file, not a .qjp, damaged, of another version, or one of which the
            range proof or a self-test fails.
    """
    check_file(path)
    with reading(path), open(path, "rb") as stream:
        data = stream.read(MOST_BYTES + 1)
    try:
        return unpack(data)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def unpack(data: bytes) -> FixedPolicy:
    """As ``read_qjp``, of the bytes of a file."""
    try:
        with np.errstate(all="ignore"):
            data = _checked(data)
            policy = read_words(data)
            same = pack(policy) == data
            _check(policy)
            right = same and _passes(policy)
    except InputError:
        raise
    except (ValueError, IndexError, KeyError, OverflowError, ZeroDivisionError) as error:
        raise InputError(f"not what a .qjp file contains ({error!s:.100})") from None
    if not same:
        raise InputError("its padding or layout is not what the converter writes")
    if not right:
        raise InputError("its self-tests give other integers")
    return policy


def _checked(data: bytes) -> bytes:
    """Words of this version, after magic, version, size and checksum."""
    if len(data) < 240 or len(data) % 4:
        raise InputError(f"{len(data)} bytes, which no .qjp file has")
    magic, version, size = (int(x) for x in np.frombuffer(data[:12], "<u4"))
    if magic != MAGIC:
        raise InputError("not a .qjp file")
    if version not in (1, VERSION):
        raise InputError(f"version {version} of the format, allowed: 1 and {VERSION}")
    if size != len(data):
        raise InputError(f"{len(data)} bytes, its header says {size}")
    if version == 1:
        intact = hashlib.sha256(data[:-32]).digest() == data[-32:]
    else:
        intact = zlib.crc32(data[:-4]).to_bytes(4, "little") == data[-4:]
    if not intact:
        raise InputError("changed since it was written: its checksum differs")
    if version == VERSION and len(data) < HEADER.itemsize + 4:
        raise InputError(f"{len(data)} bytes, which no .qjp file has")
    return upgraded(data) if version == 1 else data


def _require(condition: bool, what: str) -> None:
    if not condition:
        raise InputError(f"{what} is not allowed")


def _check(policy: FixedPolicy) -> None:
    """What ``runtime/qj_check.c`` checks, in its order."""
    network, race = policy.network, policy.race
    _require(1 <= network.output_shift <= WORD, f"an output shift of {network.output_shift}")
    _require(0 <= network.fraction_bits <= 30, f"{network.fraction_bits} fraction bits")
    _require(policy.time_step > 0, "its time step")
    ends = (network.command_low, network.command_high)
    _require(bool(np.all(ends[0] <= ends[1]) and np.all(ends[0] > -(2**31))), "a command range")
    _check_state(race)
    place = 0
    for part in race.inputs:
        _require(part.index == place, f"the place of {part.name}")
        _check_input(race, part)
        place += race.box.layout[part.name].size
    _check_track(race)
    if policy.estimator is not None:
        _check_estimator(policy.estimator)
    if policy.battery is not None:
        prove_battery(policy.battery)
    prove_network(network)


def _check_state(race: RaceTables) -> None:
    starts = np.cumsum([0, *(len(field.exponents) for field in race.fields)])
    names = [field.name for field in race.fields]
    for field, start in zip(race.fields, starts, strict=False):
        _require(field.start == start, f"the place of {field.name}")
        _require(len(field.exponents) == SIZES.get(field.name, 3), f"the size of {field.name}")
    _require(len(set(names)) == len(names) and "position" in names, "a field of the state")
    _require(max(map(abs, race.exponents)) <= LARGEST_EXPONENT, "a range of the state")


def _check_input(race: RaceTables, part: Input) -> None:
    exponent, exponents = race.box.exponent[part.name], race.exponents
    own = [exponents[i] for i in part.sources] if part.kind != GATE else []
    fine = abs(exponent) <= LARGEST_EXPONENT and 0 <= part.lag <= LARGEST_LAG
    fine &= all(source >= 0 for source in part.sources)
    size = race.box.layout[part.name].size
    if part.kind in VECTORS:
        first = next((f.start for f in race.fields if f.name == VECTORS[part.kind]), None)
        fine &= part.sources[0] == first and size == (6 if part.kind == ROTATION else 3)
    if part.kind in (POSITION, VELOCITY):
        fine &= len(set(own)) == 1 and 1 <= INPUT_BITS - own[0] + exponent <= LARGEST_SHIFT
    if part.kind == ATTITUDE:
        fine &= own == [exponent, exponent, YAW_EXPONENT]
    if part.kind == ROTATION:
        fine &= set(own) == {QUATERNION_EXPONENT}
        fine &= 1 - INPUT_BITS <= exponent <= LARGEST_SHIFT - INPUT_BITS
    if part.kind == COPY:
        fine &= set(own) == {exponent}
    if part.kind == SCALED:
        fine &= all(r is None or 1 <= r.shift <= LARGEST_SHIFT for r in part.rescales)
        numbers = [x for r in part.rescales if r is not None for x in (r.middle, r.factor)]
        fine &= all(x > -(2**31) for x in numbers)
    if part.kind == GATE:
        fine &= max(part.sources) < race.next_gate.shape[1]
    _require(bool(fine), f"the input {part.name}")


def _check_track(race: RaceTables) -> None:
    assert race.axes is not None
    units = (race.gate_position, race.axes, race.gate_cos, race.gate_sin, race.next_gate)
    _require(all(np.all(np.abs(x) <= ONE) for x in units), "a gate")
    _require(bool(np.all(np.abs(race.gate_yaw) <= LARGEST_YAW)), "the yaw of a gate")
    _require(bool(np.all(race.half_size >= 0)), "the size of a gate")


def _check_estimator(tables: EstimatorTables) -> None:
    exponents = (*tables.exponents, *tables.channel_exponents)
    _require(
        max(map(abs, exponents)) <= 96 and tables.sample_rate > 0.0, "a range of its estimator"
    )
    prove_terms(tables)
    if tables.thrust is None or tables.moment is None or tables.rpm_input is None:
        return
    fine = 1 <= tables.rpm_input.shift <= LARGEST_SHIFT and abs(tables.rpm_input.middle) <= ONE
    fine &= all(
        1 <= shift <= INPUT_BITS for shift in (*tables.thrust.shifts, *tables.moment.shifts)
    )
    _require(fine, "a scale of its residual")
    for net, inputs, outputs in ((tables.thrust, 7, 1), (tables.moment, 10, 3)):
        _prove((*net.hidden, net.output), inputs, outputs)


def prove_network(network: FixedNetwork) -> None:
    """The range proof alone, of a network without real values.

    Raises:
        InputError: see ``proof.prove_layer``.
    """
    _prove(network.layers, network.inputs, len(network.command_low))


def _prove(layers: tuple[FixedLayer, ...], inputs: int, outputs: int) -> None:
    high = np.array([ONE] * inputs, object)
    low = -high
    for index, layer in enumerate(layers):
        rows = prove_layer(index, layer, low, high, index + 1 < len(layers))
        low, high = (
            np.array([max(0, end >> WORD) for end in ends], object)
            for ends in ([row.low for row in rows], [row.high for row in rows])
        )
    _require(len(layers[-1].bias) == outputs, f"{len(layers[-1].bias)} outputs")


def _passes(policy: FixedPolicy) -> bool:
    """Whether the emulators give the integers of the self-tests."""
    own = policy.cases
    return (
        cases.passes(own, policy.network, policy.race)
        and np.array_equal(
            cases.estimates_of(policy.estimator, own.measurements.view(np.float32)), own.estimates
        )
        and np.array_equal(
            cases.digests_of(policy.battery, own.samples.view(np.float32)), own.digests
        )
    )
