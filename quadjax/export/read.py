"""Reads a ``.qjp`` file; rejects whatever the writer does not write and the C does not load."""

import zlib
from pathlib import Path

import numpy as np

from quadjax.core.errors import InputError, reading
from quadjax.core.files import check_file
from quadjax.export.battery import BatteryTables
from quadjax.export.cases import MEASUREMENTS, SAMPLES, Cases
from quadjax.export.check import check, passes
from quadjax.export.disturbances import CHANNELS, MONOMIALS, EstimatorTables, FixedResidual
from quadjax.export.integers import Rescale
from quadjax.export.network import FixedLayer, FixedNetwork
from quadjax.export.noise import NoiseTables
from quadjax.export.race_tables import TRACK, Input, RaceTables
from quadjax.export.ranges import InputBox
from quadjax.export.words import (
    BLOCK,
    HEADER,
    KINDS,
    MAGIC,
    SAMPLED_VERSION,
    STATE_FIELDS,
    STRUCTS,
    VERSION,
    FixedPolicy,
    case_groups,
    pack,
    padded,
)
from quadjax.race.layout import Layout, ObservedField
from quadjax.race.observations import fields_of
from quadjax.vehicle.registry import MODELS

MOST_BYTES = 2**24
SIZES_DIFFER = "its sizes are not those of its header"


def read_qjp(path: Path | str) -> FixedPolicy:
    """Read a ``.qjp`` file and check it.

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
            _check_intact(data)
            policy = read_words(data)
            same = pack(policy) == data
            check(policy)
            right = same and passes(policy)
    except InputError:
        raise
    except (ValueError, IndexError, KeyError, OverflowError, ZeroDivisionError) as error:
        raise InputError(f"not what a .qjp file contains ({error!s:.100})") from None
    if not same:
        raise InputError("its padding or layout is not what the converter writes")
    if not right:
        raise InputError("its self-tests give other integers")
    return policy


def read_words(data: bytes) -> FixedPolicy:
    """The policy of words whose checksum is right; no other check than that of sizes."""
    return _Reader(data[:-4]).policy()


def _check_intact(data: bytes) -> None:
    """Check magic, version, size and checksum."""
    if len(data) < HEADER.itemsize + 4 or len(data) % 4:
        raise InputError(f"{len(data)} bytes, which no .qjp file has")
    magic, version, size = (int(x) for x in np.frombuffer(data[:12], "<u4"))
    if magic != MAGIC:
        raise InputError("not a .qjp file")
    if version not in (VERSION, SAMPLED_VERSION):
        allowed = f"{VERSION} and {SAMPLED_VERSION}"
        raise InputError(f"version {version} of the format, allowed: {allowed}")
    if size != len(data):
        raise InputError(f"{len(data)} bytes, its header says {size}")
    if zlib.crc32(data[:-4]).to_bytes(4, "little") != data[-4:]:
        raise InputError("changed since it was written: its checksum differs")


# ---- words ---------------------------------------------------------------------------------------


class _Reader:
    """Takes words from the beginning on; checks no more than sizes and codes."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def take(self, dtype: np.dtype | str, count: int) -> np.ndarray:
        """The next numbers or structures, (count,)."""
        size = np.dtype(dtype).itemsize * int(count)
        if count < 0 or self._at + size > len(self._data):
            raise InputError(SIZES_DIFFER)
        self._at += size
        return np.frombuffer(self._data[self._at - size : self._at], dtype)

    def policy(self) -> FixedPolicy:
        """All words."""
        header = self.take(HEADER, 1)[0]
        vehicle = _string(header["vehicle"])
        if vehicle not in MODELS:
            raise InputError(f"vehicle model {vehicle!r}, allowed: {', '.join(MODELS)}")
        shapes = self.take(STRUCTS["layer"], header["layers"])
        race = self.race(header, vehicle)
        network = FixedNetwork(
            box=race.box,
            layers=self.layers(shapes),
            output_shift=int(header["output_shift"]),
            fraction_bits=int(header["fraction_bits"]),
            command_low=header["low"].astype(np.int64),
            command_high=header["high"].astype(np.int64),
            model=MODELS[vehicle],
        )
        estimator = self.estimator() if header["estimator"] else None
        battery = None
        if header["battery"]:
            battery = BatteryTables(*self.take(STRUCTS["battery"], 1)[0].tolist())
        noise = None
        if header["version"] == SAMPLED_VERSION:
            factors, *numbers = self.take(STRUCTS["noise"], 1)[0].tolist()
            noise = NoiseTables(tuple(factors.tolist()), bool(numbers[0]), numbers[1])
        cases = self.cases(header)
        if self._at != len(self._data):
            raise InputError(SIZES_DIFFER)
        source = header["source"].astype("<u4").tobytes().hex()
        tables = (network, race, estimator, battery)
        return FixedPolicy(*tables, _string(header["name"]), source, cases, noise)

    def race(self, header: np.ndarray, vehicle: str) -> RaceTables:
        """State, observation and track."""
        fields = self.take(STRUCTS["field"], int(header["fields"]))
        exponents = self.take("<i4", int(header["state_size"])).astype(np.int64)
        parts = self.take(STRUCTS["part"], int(header["parts"]))
        numbers = self.take(STRUCTS["input"], int(header["inputs"]))
        count, size = int(header["gates"]), STRUCTS["gate"].itemsize // 4
        columns = size + int(header["constants"])
        track = self.take("<i4", count * columns).reshape(count, columns)
        gates = np.ascontiguousarray(track[:, :size]).view(STRUCTS["gate"])[:, 0]
        return RaceTables(
            box=_box(parts, vehicle),
            fields=dict(_state_field(row, exponents) for row in fields),
            inputs=tuple(_input(part, numbers) for part in parts),
            track=gates.astype(TRACK),
            next_gate=track[:, size:].astype(np.int64),
            world_box=bool(header["world_box"]),
            time_step=float(header["period_ns"] / 1e9),
        )

    def layers(self, shapes: np.ndarray) -> tuple[FixedLayer, ...]:
        """Hidden layers and the output layer, without their padding."""
        layers = []
        for number, (rows, columns) in enumerate(shapes.tolist(), start=1):
            if rows < 1 or columns < 1:
                raise InputError(f"layer {number - 1}: {rows} rows of {columns}, allowed: above 0")
            height, width = padded(rows, columns, number < len(shapes))
            blocks = self.take("<i4", height * width).reshape(-1, width, BLOCK)
            weights = blocks.transpose(0, 2, 1).reshape(height, width)[:rows, :columns]
            bias = self.take("<i8", height)[:rows].astype(np.int64)
            layers.append(FixedLayer(weights.astype(np.int32), bias, np.full(rows, np.nan)))
        return tuple(layers)

    def estimator(self) -> EstimatorTables:
        """The estimator of the disturbances."""
        header = self.take(STRUCTS["estimator"], 1)[0]
        terms = self.take(STRUCTS["term"], header["terms"])
        thrust, moment = (
            self.take(STRUCTS["layer"], header[f"{name}_layers"]) for name in ("thrust", "moment")
        )
        if (len(thrust) == 0) != (len(moment) == 0):
            raise InputError("its estimator has one residual network, allowed: none or two")
        residual = None
        if len(thrust):
            rpm = Rescale(*(int(header[f"rpm_{key}"]) for key in ("middle", "factor", "shift")))
            shifts = (int(header["thrust_shift"]), *header["moment_shift"].tolist())
            residual = FixedResidual(rpm, self.layers(thrust), self.layers(moment), shifts)
        model = np.zeros((len(CHANNELS) + 3, len(MONOMIALS)), np.int64)
        model[terms["channel"], terms["monomial"]] = terms["factor"]
        return EstimatorTables(
            period_ns=int(header["period_ns"]),
            exponents=tuple(header["exponents"].tolist()),
            channel_exponents=tuple(header["channels"].tolist()),
            model=model,
            a1=int(header["a1"]),
            a2=int(header["a2"]),
            gain=int(header["gain"]),
            residual=residual,
        )

    def cases(self, header: np.ndarray) -> Cases:
        """The self-tests."""
        disturbances, battery = bool(header["estimator"]), bool(header["battery"])
        counts = (
            int(header["network_tests"]),
            int(header["race_tests"]),
            MEASUREMENTS * disturbances,
            SAMPLES * disturbances,
            MEASUREMENTS * battery,
            SAMPLES * battery,
        )
        arrays: dict[str, np.ndarray] = {}
        groups = case_groups(int(header["inputs"]), int(header["state_size"]))
        for count, group in zip(counts, groups, strict=True):
            width = sum(group.values())
            rows = self.take("<u4", count * width).reshape(count, width)
            columns = np.split(rows, np.cumsum(list(group.values()))[:-1], axis=1)
            arrays |= dict(zip(group, columns, strict=True))
        return Cases(**arrays)


def _string(words: np.ndarray) -> str:
    return words.astype("<u4").tobytes().partition(b"\0")[0].decode("ascii", "replace")


def _state_field(row: np.ndarray, exponents: np.ndarray) -> tuple[str, tuple[int, ...]]:
    code, start, size = row.tolist()
    if not 1 <= code <= len(STATE_FIELDS):
        raise InputError(f"field {code} of its state, allowed: 1 to {len(STATE_FIELDS)}")
    return STATE_FIELDS[code - 1], tuple(exponents[start : start + size].tolist())


def _box(parts: np.ndarray, vehicle: str) -> InputBox:
    """The declared ranges, by field."""
    units = {field.name: (field.unit, field.frame) for field in fields_of(MODELS[vehicle]).values()}
    fields, scaled_fields, exponent = [], [], {}
    for part in parts:
        name, kind = _string(part["name"]), int(part["kind"])
        if not 1 <= kind <= len(KINDS):
            raise InputError(f"kind {kind} of its inputs, allowed: 1 to {len(KINDS)}")
        exponent[name] = int(part["exponent"])
        unit, frame = units.get(name, ("", ""))
        fields.append(ObservedField(name, int(part["size"]), unit, frame, 2.0 ** exponent[name]))
        scaled_fields += [name] if KINDS[kind - 1] == "scaled" else []
    return InputBox(Layout(tuple(fields)), exponent, tuple(scaled_fields))


def _input(part: np.ndarray, numbers: np.ndarray) -> Input:
    """How a field of the observation is computed."""
    index, size = int(part["index"]), int(part["size"])
    rows = numbers[index : index + size] if index >= 0 else numbers[:0]
    if not len(rows) or len(rows) != size:
        raise InputError(f"{size} inputs from number {index} on, of {len(numbers)}")
    return Input(_string(part["name"]), KINDS[part["kind"] - 1], index, rows)
