"""Files of earlier versions as flights."""

from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_npz
from quadjax.core.sections import validate
from quadjax.flights.flight import MOTION, Flight, Signal, motion_signals, vehicle_signals
from quadjax.flights.gates import passages, passages_at
from quadjax.race.track import GateSection
from quadjax.vehicle.registry import MODELS

STATES, LIMIT, STARTS = "quadjax-states/1", "quadjax-limit/1", "quadjax-starts/1"
OLD_FORMATS = (STATES, LIMIT, STARTS)  # of .npz files
OLD_NAMES = {"attitude": "euler"}
OLD_SIGNALS = ("position", "velocity", "euler", "rates", "actuators", "command")
Arrays = dict[str, np.ndarray]
Meta = dict[str, Any]


def read_old(path: Path, gates: tuple[GateSection, ...], name: str) -> list[Flight]:
    """The flights of an ``.npz`` file of one of the ``OLD_FORMATS``; arguments as of ``load``."""
    names = (*OLD_SIGNALS, "time", "target", "lap_times", "leg_times")
    arrays, meta = read_npz(path, OLD_FORMATS, names)
    needed, read = READERS[meta["format"]]
    track = meta.get("track") if meta["format"] != STARTS else []
    for key in needed:
        if key not in arrays:
            raise InputError(f"{path}: no array {key}, which {meta['format']} has")
        if arrays[key].dtype.kind not in "fiu":
            raise InputError(f"{path}: {key} holds no numbers")
    try:
        return read(arrays, meta, gates_of(path, "track", track) or gates, name)
    except (IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: arrays of shapes that do not fit ({error})") from error


def gates_of(path: Path, key: str, values: Any) -> tuple[GateSection, ...]:
    """The gates of the metadata of a file, under a key."""
    if not isinstance(values or [], list):
        raise InputError(f"{path}: {key} is {values!r:.80}, expected a list")
    pairs = enumerate(values or [])
    return tuple(validate(GateSection, each, f"{path}: {key}[{index}]") for index, each in pairs)


def _old_flight(
    name: str, time: np.ndarray, arrays: Arrays, meta: Meta, gates: tuple[GateSection, ...]
) -> Flight:
    """The signals of an earlier format; code that a file names is not imported."""
    model = MODELS.get(str(meta.get("vehicle")))
    motion = motion_signals({key: arrays[OLD_NAMES.get(key, key)] for key in MOTION})
    command = arrays.get("command", np.zeros((len(time), 0)))
    signals = motion | vehicle_signals(model, command, arrays["actuators"])
    for key, signal in signals.items():
        if signal.values.ndim != 2 or len(signal.values) != len(time):
            raise ValueError(f"{key} has the shape {signal.values.shape}")
    if "target" in arrays:
        signals["target"] = Signal(np.asarray(arrays["target"], np.float64)[:, None])
    return Flight(name, time, signals, gates, source={"vehicle": model.name} if model else {})


def _read_states(
    arrays: Arrays, meta: Meta, gates: tuple[GateSection, ...], name: str
) -> list[Flight]:
    """The runs of an evaluation, each cut at its end; without targets the openings count."""
    reasons = {crash["run"]: str(crash["reason"]) for crash in meta.get("crashes", [])}
    flights, several = [], len(arrays["lap_times"]) > 1
    for run, laps in enumerate(arrays["lap_times"]):
        end = int(np.isfinite(arrays["position"][run, :, 0]).sum())
        of_run = {k: arrays[k][run, :end] for k in (*OLD_SIGNALS, "target") if k in arrays}
        label, time = f"{name} {run + 1}" if several else name, arrays["time"][:end]
        flight, crash = _old_flight(label, time, of_run, meta, gates), reasons.get(run)
        target = of_run.get("target")
        passed = passages(time, flight["position"], gates, target=target, cut=crash is None)
        ends = np.cumsum(laps[np.isfinite(laps)])
        flights.append(flight.replace(passages=passed, lap_ends=ends, crash=crash))
    return flights


def _read_limit(
    arrays: Arrays, meta: Meta, gates: tuple[GateSection, ...], name: str
) -> list[Flight]:
    """The best known flight, whose gates are at the ends of its legs."""
    when, time = np.cumsum(arrays["leg_times"]), arrays["time"]
    # A node at the end of a leg has the next gate ahead.
    legs = np.arange(len(time)) * len(when) // max(len(time) - 1, 1)
    target = legs % (len(gates) or len(when))
    flight = _old_flight(name, time, arrays | {"target": target}, meta, gates)
    periodic = meta.get("start") == "periodic"
    note = "best known lap, flying start" if periodic else "best known flight from hover"
    return [
        flight.replace(
            passages=passages_at(time, flight["position"], gates, when),
            lap_ends=when[len(gates) - 1 :: len(gates)] if gates else when[:0],
            source=flight.source | {"periodic": periodic, "note": note},
        )
    ]


def _read_starts(
    arrays: Arrays, meta: Meta, gates: tuple[GateSection, ...], name: str
) -> list[Flight]:
    """Single states in which episodes start, as the samples of one flight, 1 s apart."""
    time = np.arange(len(arrays["target"]), dtype=np.float64)
    return [_old_flight(name, time, arrays, meta, gates).replace(source={"starts": True})]


READERS = {  # by format: the arrays that it has, and its reader
    STATES: (("time", *OLD_SIGNALS, "lap_times"), _read_states),
    LIMIT: (("time", *OLD_SIGNALS, "leg_times"), _read_limit),
    STARTS: ((*OLD_SIGNALS[:-1], "target"), _read_starts),
}
