"""Files of flights: one format that is written, and readers of earlier ones.

The written file (``.npz``, format ``quadjax-flights/2``) has, for f flights of at most n samples,
``time`` (f, n), s, each signal (f, n, k) by its name, ``passages`` (f, m, 3) and ``lap_ends``
(f, laps), s, with NaN where a flight has less; and ``meta``, JSON: ``gates`` of the track, and
``flights``, of each flight its ``name``, ``crash``, ``source`` and ``signals``: unit and labels by
name.
"""

import base64
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.errors import InputError
from quadjax.core.files import read_json, read_npz, whole_file, write_npz
from quadjax.core.sections import build
from quadjax.flights.flight import MOTION, Flight, Signal, motion_signals, vehicle_signals
from quadjax.flights.gates import clearance, is_same_track, passages
from quadjax.race.track import GateSection
from quadjax.vehicle.registry import MODELS

FORMAT = "quadjax-flights/2"
RECORD = "quadjax-flights/1"  # JSON: the data of a page
STATES, LIMIT, STARTS = "quadjax-states/1", "quadjax-limit/1", "quadjax-starts/1"
FORMATS = (FORMAT, STATES, LIMIT, STARTS)  # of .npz files
WITH_ONE_NAME = ("time", "passages", "lap_ends")
OLD_NAMES = {"attitude": "euler"}  # in files of earlier formats
OLD_SIGNALS = ("position", "velocity", "euler", "rates", "actuators", "command")
MISSING = -32768  # of the integers of a record: no value


def save(flights: Sequence[Flight], path: Path | str, **meta: Any) -> None:
    """Write flights of one track: as arrays (``.npz``), or as a table (``.csv``).

    Args:
        flights: at least one.
        path: of the file.
        **meta: further entries of the metadata of an ``.npz`` file.

    Raises:
        InputError: another suffix, no flight, or flights of different tracks.
    """
    suffix, tracks = Path(path).suffix, [flight.gates for flight in flights if flight.gates]
    if not flights or not all(is_same_track(tracks[0], other) for other in tracks):
        raise InputError(f"{path}: no flights, or of several tracks, allowed: one or more of one")
    if suffix == ".csv":
        return _save_table(flights, path)
    if suffix != ".npz":
        raise InputError(f"{path}: suffix is {suffix!r}, allowed: .npz, .csv")
    names = dict.fromkeys(name for flight in flights for name in flight.signals)
    arrays = {name: _stacked([getattr(f, name) for f in flights]) for name in WITH_ONE_NAME}
    for name in names:
        parts = [f[name] if name in f.signals else np.zeros((0, 0)) for f in flights]
        arrays[name] = _stacked(parts)
    about = [
        {"name": f.name, "crash": f.crash, "source": f.source, "signals": _signals_to_json(f)}
        for f in flights
    ]
    gates = [gate.model_dump(mode="json") for gate in (tracks[0] if tracks else ())]
    write_npz(path, arrays, meta | {"format": FORMAT, "gates": gates, "flights": about})


def _signals_to_json(flight: Flight) -> dict[str, Any]:
    return {
        name: {"unit": signal.unit, "labels": signal.labels, "size": signal.values.shape[1]}
        for name, signal in flight.signals.items()
    }


def _stacked(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Arrays of different sizes as one, with NaN where one has less."""
    shape = np.max([part.shape for part in parts], axis=0)
    whole = np.full((len(parts), *shape), np.nan)
    for row, part in zip(whole, parts, strict=True):
        row[tuple(slice(size) for size in part.shape)] = part
    return whole


def _save_table(flights: Sequence[Flight], path: Path | str) -> None:
    """A line for each time of each flight; the header has the units."""
    columns = ["run", "time [s]"]
    for name, signal in flights[0].signals.items():
        count = signal.values.shape[1]
        units = (signal.unit,) * count if isinstance(signal.unit, str) else signal.unit
        labels = signal.labels or tuple(str(i + 1) for i in range(count))
        labels = tuple(label.split(",")[0].replace(" ", "_") for label in labels)
        own = [f"{name}_{label}" for label in labels] if count > 1 else [name]
        columns += [
            f"{label} [{unit}]" if unit else label for label, unit in zip(own, units, strict=True)
        ]
    rows = [
        np.column_stack(
            [np.full(len(f.time), run), f.time, *(f[name] for name in flights[0].signals)]
        )
        for run, f in enumerate(flights)
    ]
    header = ",".join(columns)
    with whole_file(path) as temporary:
        np.savetxt(temporary, np.concatenate(rows), "%.9g", ",", header=header, comments="")


def load(path: Path | str, gates: Sequence[GateSection] = (), name: str = "") -> list[Flight]:
    """The flights of a file.

    Args:
        path: an ``.npz`` file of ``save``, of ``quadjax evaluate --states``, of ``quadjax limit
            --npz`` or of recorded starts; or a ``.json`` file of ``quadjax evaluate --json``,
            ``quadjax limit --json`` or a page of an earlier version. Lap times without a trajectory
            are a flight without samples.
        gates: of the track, for a file that has none.
        name: of the flights; the file's stem if not given. Several are numbered from 1.

    Raises:
        InputError: a file that cannot be read, of another format, or with a missing array.
    """
    path = Path(path)
    if path.suffix == ".json":
        return _read_record(path, name or path.stem)
    return _read_npz(path, tuple(gates), name or path.stem)


def _read_npz(path: Path, gates: tuple[GateSection, ...], name: str) -> list[Flight]:
    old = (*OLD_SIGNALS, *WITH_ONE_NAME, "target", "lap_times", "leg_times")
    arrays, meta = read_npz(path, FORMATS, old)
    if meta["format"] == FORMAT:
        return _read_flights(path)
    track = meta.get("track") if meta["format"] != STARTS else []
    gates = _gates_of(path, "track", track) or gates
    needed = {
        STATES: ("time", *OLD_SIGNALS, "lap_times"),
        LIMIT: ("time", *OLD_SIGNALS, "leg_times"),
        STARTS: (*OLD_SIGNALS[:-1], "target"),
    }[meta["format"]]
    for key in needed:
        if key not in arrays:
            raise InputError(f"{path}: no array {key}, which {meta['format']} has")
        if arrays[key].dtype.kind not in "fiu":
            raise InputError(f"{path}: {key} holds no numbers")
    read = {STATES: _read_states, LIMIT: _read_limit, STARTS: _read_starts}[meta["format"]]
    try:
        return read(arrays, meta, gates, name)
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: arrays of shapes that do not fit ({error})") from error


def _gates_of(path: Path, key: str, values: Any) -> tuple[GateSection, ...]:
    if not isinstance(values or [], list):
        raise InputError(f"{path}: {key} is {values!r:.80}, expected a list")
    pairs = enumerate(values or [])
    return tuple(build(GateSection, each, f"{path}: {key}[{index}]") for index, each in pairs)


def _read_flights(path: Path) -> list[Flight]:
    """The flights of ``save``."""
    _, meta = read_npz(path, FORMAT)
    gates = _gates_of(path, "gates", meta.get("gates"))
    try:
        names = {name for about in meta["flights"] for name in about["signals"]}
        if odd := [name for name in names if not re.fullmatch(r"\w{1,40}", name)]:
            raise InputError(f"{path}: a signal is called {odd[0]!r:.80}")
        arrays, _ = read_npz(path, FORMAT, (*WITH_ONE_NAME, *names))
        return [_flight_at(arrays, gates, about, i) for i, about in enumerate(meta["flights"])]
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        text = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: arrays and meta do not fit ({text[:200]})") from error


def _flight_at(
    arrays: dict[str, np.ndarray],
    gates: tuple[GateSection, ...],
    about: dict[str, Any],
    index: int,
) -> Flight:
    time = arrays["time"][index].astype(np.float64)
    count = int(np.isfinite(time).sum())
    passed, ends = arrays["passages"][index].reshape(-1, 3), arrays["lap_ends"][index]
    signals = {}
    for name, (unit, labels, size) in (
        (name, (each["unit"], each["labels"], each["size"]))
        for name, each in about["signals"].items()
    ):
        values = arrays[name][index, :count, :size].astype(np.float64)
        if values.shape != (count, size):
            raise ValueError(f"{name} has the shape {values.shape}")
        unit = unit if isinstance(unit, str) else tuple(map(str, unit))
        signals[name] = Signal(values, unit, tuple(map(str, labels)))
    crash = about["crash"]
    return Flight(
        name=str(about["name"]),
        time=time[:count],
        signals=signals,
        gates=gates,
        passages=passed[np.isfinite(passed[:, 0])].astype(np.float64),
        lap_ends=ends[np.isfinite(ends)].astype(np.float64),
        crash=None if crash is None else str(crash),
        source=dict(about["source"]),
    )


def _old_flight(
    name: str,
    time: np.ndarray,
    arrays: dict[str, np.ndarray],
    meta: dict[str, Any],
    gates: tuple[GateSection, ...],
) -> Flight:
    """The signals of an earlier format; code that a file names is not imported."""
    model = MODELS.get(str(meta.get("vehicle")))
    motion = motion_signals({key: arrays[OLD_NAMES.get(key, key)] for key in MOTION})
    command = arrays.get("command", np.zeros((len(time), 0)))
    signals = motion | vehicle_signals(model, command, arrays["actuators"])
    for key, signal in signals.items():
        if signal.values.ndim != 2 or len(signal.values) != len(time):
            raise ValueError(f"{key} has the shape {signal.values.shape}")
    source = {"vehicle": model.name} if model else {}
    return Flight(name, time, signals, gates, source=source)


def _read_states(
    arrays: dict[str, np.ndarray], meta: dict[str, Any], gates: tuple[GateSection, ...], name: str
) -> list[Flight]:
    """The runs of an evaluation, each cut at its end; without targets the openings count."""
    reasons = {each["run"]: str(each["reason"]) for each in meta.get("crashes", [])}
    flights, several = [], len(arrays["lap_times"]) > 1
    for run, laps in enumerate(arrays["lap_times"]):
        end = int(np.isfinite(arrays["position"][run, :, 0]).sum())
        own = {key: arrays[key][run, :end] for key in OLD_SIGNALS}
        label, time = f"{name} {run + 1}" if several else name, arrays["time"][:end]
        flight = _old_flight(label, time, own, meta, gates)
        target = arrays["target"][run, :end] if "target" in arrays else None
        ends, crash = np.cumsum(laps[np.isfinite(laps)]), reasons.get(run)
        passed = passages(time, own["position"], gates, target=target, cut=crash is None)
        if target is not None:
            flight = flight.replace(signals=flight.signals | {"target": Signal(target[:, None])})
        flights.append(flight.replace(passages=passed, lap_ends=ends, crash=crash))
    return flights


def _read_limit(
    arrays: dict[str, np.ndarray], meta: dict[str, Any], gates: tuple[GateSection, ...], name: str
) -> list[Flight]:
    """The best known flight, whose gates are at the ends of its legs."""
    flight = _old_flight(name, arrays["time"], arrays, meta, gates)
    when = np.cumsum(arrays["leg_times"])
    periodic = meta.get("start") == "periodic"
    # A node at the end of a leg has the next gate ahead.
    legs = np.arange(len(flight.time)) * len(when) // max(len(flight.time) - 1, 1)
    target = Signal((legs % (len(gates) or len(when)))[:, None].astype(np.float64))
    note = "best known lap, flying start" if periodic else "best known flight from hover"
    return [
        flight.replace(
            passages=passages_at(flight.time, flight["position"], gates, when),
            lap_ends=when[len(gates) - 1 :: len(gates)] if gates else when[:0],
            signals=flight.signals | {"target": target},
            source=flight.source | {"periodic": periodic, "note": note},
        )
    ]


def passages_at(
    time: np.ndarray, position: np.ndarray, gates: Sequence[GateSection], when: np.ndarray
) -> np.ndarray:
    """As ``passages``, of a flight that passes the gates in order at times (k,), s.

    Without gates their indices are those of the legs, and their distances NaN.
    """
    if not gates:
        return np.stack([when, np.arange(len(when)), np.full(len(when), np.nan)], axis=1)
    order = [index % len(gates) for index in range(len(when))]
    places = np.stack([np.interp(when, time, column) for column in position.T], axis=1)
    clear = [
        clearance(gates[index], ((place - gates[index].position) @ np.array(gates[index].axes))[1:])
        for index, place in zip(order, places, strict=True)
    ]
    return np.stack([when, np.array(order, float), np.array(clear)], axis=1)


def _read_starts(
    arrays: dict[str, np.ndarray], meta: dict[str, Any], gates: tuple[GateSection, ...], name: str
) -> list[Flight]:
    """Single states in which episodes start, as the samples of one flight, 1 s apart."""
    time = np.arange(len(arrays["target"]), dtype=np.float64)
    flight = _old_flight(name, time, arrays, meta, gates)
    target = Signal(arrays["target"][:, None].astype(np.float64))
    return [flight.replace(signals=flight.signals | {"target": target}, source={"starts": True})]


def _read_record(path: Path, name: str) -> list[Flight]:
    """Flights or lap times of a JSON file."""
    value = read_json(path)
    if value.get("format") == RECORD:
        try:
            gates = tuple(_gate_of_record(path, each) for each in value["gates"])
            flights = [_flight_of_record(each, gates) for each in value["flights"]]
            markers = value["markers"]
            return flights + [lap_times(m["name"], np.diff([0.0, *m["lap_ends"]])) for m in markers]
        except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
            text = f"{type(error).__name__}: {error}"
            raise InputError(f"{path}: damaged, not {RECORD} ({text[:200]})") from error
    if "format" in value:
        raise InputError(f"{path}: format is {value['format']!r:.80}, expected {RECORD}")
    if "best_known" in value and value.get("start") == "periodic":
        return [lap_times(name, [float(value["best_known"])])]
    laps = value.get("laps")
    try:
        rows = [np.array(row, np.float64) for row in laps] if isinstance(laps, list) else []
    except (TypeError, ValueError):
        rows = []
    whole = [row for row in rows if row.ndim == 1 and len(row) and np.isfinite(row).all()]
    if not whole:
        text = f"expected format {RECORD}, or laps: lists of times of complete runs"
        raise InputError(f"{path}: {text}")
    return [lap_times(name, min(whole, key=lambda row: float(row.sum())))]


def _gate_of_record(path: Path, value: dict[str, Any]) -> GateSection:
    axes = np.array(value["axes"], np.float64).reshape(3, 3)
    yaw, pitch, roll = Rotation.from_matrix(axes).as_euler("ZYX", degrees=True)
    angles = {"yaw_deg": float(yaw), "pitch_deg": float(pitch), "roll_deg": float(roll)}
    own = {key: value[key] for key in ("position", "size", "shape")}
    return build(GateSection, own | angles, f"{path}: gates")


def _flight_of_record(value: dict[str, Any], gates: tuple[GateSection, ...]) -> Flight:
    """A flight whose signals are base64 of 16-bit integers."""
    time = np.frombuffer(base64.b64decode(value["time"]), "<f4").astype(np.float64)
    arrays, signals = {}, {}
    for each in value["signals"]:
        integers = np.frombuffer(base64.b64decode(each["data"]), "<i2").reshape(len(time), -1)
        known = np.where(integers == MISSING, np.nan, integers)
        arrays[each["name"]] = np.array(each["offset"]) + np.array(each["scale"]) * known
        if "title" in each:
            values, labels = arrays[each["name"]], tuple(map(str, each["labels"]))
            title = re.sub(r"\W+", "_", each["title"])[:40]
            signals[title] = Signal(values, str(each["unit"]), labels)
    turns = Rotation.from_quat(np.roll(arrays["attitude"], -1, axis=1))
    arrays["attitude"] = turns.as_euler("ZYX")[:, ::-1]
    passed = [[np.nan if x is None else float(x) for x in row] for row in value["passages"]]
    return Flight(
        name=str(value["name"]),
        time=time,
        signals=motion_signals(arrays) | signals,
        gates=gates,
        passages=np.array(passed, np.float64).reshape(-1, 3),
        lap_ends=np.array(value["lap_ends"], np.float64),
        crash=str(value.get("crash") or "") or None,
        source={"note": str(value.get("note", ""))},
    )


def lap_times(name: str, times: Sequence[float] | np.ndarray) -> Flight:
    """Lap times (laps,), s, without a trajectory: a flight without samples."""
    return Flight(name, np.zeros(0), {}, lap_ends=np.cumsum(np.asarray(times, np.float64)))
