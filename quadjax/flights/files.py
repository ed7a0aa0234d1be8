"""Files of flights, and of lap times.

World frame NED, body frame FRD. A file of flights (``.npz``, format ``quadjax-flights/2``) has, for
f flights of at most n samples, with NaN where a flight has less:

- ``time`` (f, n), s; ``position`` and ``velocity`` (f, n, 3), m and m/s, world;
- ``attitude`` (f, n, 3), roll, pitch, yaw, rad; ``rates`` (f, n, 3), rad/s, body;
- ``actuators`` and ``command`` (f, n, k), in the units of the vehicle model;
- ``target`` (f, n, 1), the gate to pass next, from 0; other signals (f, n, k), as of a flight log;
- ``passages`` (f, m, 3): time, s; gate; distance from the edge of its opening, m;
- ``lap_ends`` (f, laps), s;
- ``meta``, JSON: ``format``, ``gates`` of the track, and ``flights``, of each flight its ``name``,
  ``crash`` (null where it did not end early), ``source`` and ``signals``: ``unit``, ``labels`` and
  ``size`` by name; and the entries of the JSON of the command that wrote it.

The file of ``quadjax limit`` has the nodes of the mesh, ``leg_times`` (legs,), s, and
``flown_position`` (m + 1, 3) and ``flown_command`` (m, commands) of the flight that verifies it,
each command held for 1 ms; or, if none does, only the nodes, and the reason as ``not_verified`` in
``meta``.

A ``.csv`` file has a line for each time of each flight. Its header has the units: ``run``,
``time [s]``, ``position_x [m]``, .., ``command_front_left [rpm]``, .. Runs and gates are numbered
from 0.
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.errors import InputError, reading
from quadjax.core.files import read_json, read_npz, whole_file, write_npz
from quadjax.core.sections import validate
from quadjax.flights.flight import Flight, Signal, numbered
from quadjax.flights.gates import is_same_track
from quadjax.race.track import GateSection

FORMAT = "quadjax-flights/2"
WITH_ONE_NAME = ("time", "passages", "lap_ends")
TABLE_COLUMNS = ("run", "time [s]")  # the first ones of a ``.csv`` file


def save(
    flights: Sequence[Flight],
    path: Path | str,
    more: Mapping[str, np.ndarray] | None = None,
    **meta: Any,
) -> None:
    """Write flights of one track: as arrays (``.npz``), or as a table (``.csv``).

    Args:
        flights: at least one.
        path: of the file.
        more: further arrays of an ``.npz`` file, which ``load`` does not read.
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
    write_npz(
        path, arrays | dict(more or {}), meta | {"format": FORMAT, "gates": gates, "flights": about}
    )


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
    columns = list(TABLE_COLUMNS)
    for name, signal in flights[0].signals.items():
        count = signal.values.shape[1]
        units = (signal.unit,) * count if isinstance(signal.unit, str) else signal.unit
        labels = signal.labels or tuple(str(i + 1) for i in range(count))
        labels = tuple(label.split(",")[0].replace(" ", "_") for label in labels)
        names = [f"{name}_{label}" for label in labels] if count > 1 else [name]
        columns += [
            f"{label} [{unit}]" if unit else label for label, unit in zip(names, units, strict=True)
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


def is_table(path: Path | str) -> bool:
    """Whether a file is a ``.csv`` table of ``save``, which ``load`` does not read."""
    with reading(path), open(path, "rb") as file:
        return file.readline(100).startswith(",".join(TABLE_COLUMNS).encode())


def load(path: Path | str, name: str = "") -> list[Flight]:
    """The flights of a file.

    Args:
        path: an ``.npz`` file of ``save``, of ``quadjax evaluate --states`` or of ``quadjax limit
            --npz``; or a ``.json`` file of ``quadjax evaluate --json`` or ``quadjax limit --json``,
            whose lap times are a flight without samples.
        name: of the flights, several of which are numbered. If not given: those in the file, or the
            file's stem for lap times.

    Raises:
        InputError: a file that cannot be read, of another format, or with a missing array.
    """
    path = Path(path)
    if path.suffix == ".json":
        return [_read_json(path, name or path.stem)]
    _, meta = read_npz(path, FORMAT)
    gates = _gates_of(path, meta.get("gates"))
    try:
        names = {name for about in meta["flights"] for name in about["signals"]}
        if odd := [name for name in names if not re.fullmatch(r"\w{1,40}", name)]:
            raise InputError(f"{path}: a signal is called {odd[0]!r:.80}")
        arrays, _ = read_npz(path, FORMAT, (*WITH_ONE_NAME, *names))
        flights = [_flight_at(arrays, gates, about, i) for i, about in enumerate(meta["flights"])]
        labels = numbered(name, len(flights)) if name else [flight.name for flight in flights]
        return [flight.replace(name=x) for flight, x in zip(flights, labels, strict=True)]
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        text = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: arrays and meta do not fit ({text[:200]})") from error


def _gates_of(path: Path, values: Any) -> tuple[GateSection, ...]:
    """The gates of the metadata of a file."""
    if not isinstance(values or [], list):
        raise InputError(f"{path}: gates is {values!r:.80}, expected a list")
    pairs = enumerate(values or [])
    return tuple(validate(GateSection, each, f"{path}: gates[{index}]") for index, each in pairs)


def _flight_at(
    arrays: dict[str, np.ndarray], gates: tuple[GateSection, ...], about: dict[str, Any], index: int
) -> Flight:
    time = arrays["time"][index].astype(np.float64)
    count = int(np.isfinite(time).sum())
    passed, ends = arrays["passages"][index].reshape(-1, 3), arrays["lap_ends"][index]
    signals = {}
    for name, record in about["signals"].items():
        unit, size = record["unit"], record["size"]
        values = arrays[name][index, :count, :size].astype(np.float64)
        if values.shape != (count, size):
            raise ValueError(f"{name} has the shape {values.shape}")
        unit = unit if isinstance(unit, str) else tuple(map(str, unit))
        signals[name] = Signal(values, unit, tuple(map(str, record["labels"])))
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


def _read_json(path: Path, name: str) -> Flight:
    """Lap times of a JSON file, of the fastest complete run or of a best known lap."""
    value = read_json(path)
    if "best_known" in value and value.get("start") == "periodic":
        laps: object = [[value["best_known"]]]
    else:
        laps = value.get("laps")
    try:
        rows = [np.array(row, np.float64) for row in laps] if isinstance(laps, list) else []
    except (TypeError, ValueError):
        rows = []
    whole = [row for row in rows if row.ndim == 1 and len(row) and np.isfinite(row).all()]
    if not whole:
        raise InputError(f"{path}: expected laps: lists of times of complete runs, or best_known")
    return lap_times(name, min(whole, key=lambda row: float(row.sum())))


def lap_times(name: str, times: Sequence[float] | np.ndarray) -> Flight:
    """Lap times (laps,), s, without a trajectory: a flight without samples."""
    return Flight(name, np.zeros(0), {}, lap_ends=np.cumsum(np.asarray(times, np.float64)))
