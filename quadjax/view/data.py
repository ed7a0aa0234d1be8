"""The data of a page: gates and flights as JSON, with signals as base64 of 16-bit integers."""

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

from quadjax.core.errors import InputError
from quadjax.flights.flight import MOTORS, Flight, Signal
from quadjax.flights.gates import is_same_track
from quadjax.race.track import GateSection

ARM_M, ROTOR_M = 0.12, 0.076  # center to rotor and radius of a rotor, of a Bebop
RECORD = "quadjax-flights/1"  # format of the data of a page
MAX_NAMED_FLIGHTS = 3  # flights in a title
MISSING = -32768  # of its integers: no value
TURNS = {"rpm": 1.0 / 60.0, "rad/s": 0.5 / np.pi}  # per second, of one unit of a rotor speed
NOT_IN_A_STRIP = ("position", "velocity", "body_velocity", "attitude", "target", "flying")
FIRST = ("command", "actuators", "rates")  # of the strips
QUANTITIES = {"rad/s": "body rates", "m/s^2": "thrust"}  # of commands


def page_record(title: str, flights: Sequence[Flight]) -> dict[str, Any]:
    """Flights on one track as JSON takes them; flights without samples mark lap times.

    They start together. Periodic laps are repeated as often as the others have laps.

    Raises:
        InputError: no flight with samples, one that cannot be drawn, or flights on other tracks.
    """
    recorded = [flight for flight in flights if len(flight.time)]
    if not recorded:
        raise InputError("no flight to show" + ", only lap times" * bool(flights))
    tracks = [flight for flight in recorded if flight.gates]
    for other in tracks[1:]:
        if not is_same_track(tracks[0].gates, other.gates):
            raise InputError(f"{other.name}: is on another track than {tracks[0].name}")
    laps = max(len(flight.lap_ends) for flight in recorded)
    marks = {f.name: f.lap_ends for f in flights if not len(f.time)}
    return {
        "format": RECORD,
        "title": title,
        "gates": [_gate_record(gate) for gate in (tracks[0].gates if tracks else ())],
        "drone": {"arm": ARM_M, "rotor": ROTOR_M},
        "flights": [_flight_record(flight.repeat(laps)) for flight in recorded],
        "markers": [{"name": name, "lap_ends": _numbers(ends)} for name, ends in marks.items()],
    }


def make_title(flights: Sequence[Flight], track: str = "") -> str:
    """A title: what flies, with the drone and the track where these are known and the same.

    Args:
        flights: of a page.
        track: name of the track of flights that do not name their race.
    """
    names = [flight.name for flight in flights if len(flight.time)]
    races = {str(flight.source.get("race", track)) for flight in flights if len(flight.time)}
    listed = ", ".join(names) if len(names) <= MAX_NAMED_FLIGHTS else f"{len(names)} flights"
    return f"{listed}: {races.pop()}" if len(races) == 1 and races != {""} else listed


def _gate_record(gate: GateSection) -> dict[str, Any]:
    """A gate as JSON takes it: center, axes (9,) by rows, size, shape."""
    return {
        "position": _numbers(np.array(gate.position)),
        "axes": _numbers(np.array(gate.axes, np.float64).ravel()),
        "size": _numbers(np.array(gate.size)),
        "shape": gate.shape,
    }


def _flight_record(flight: Flight) -> dict[str, Any]:
    """A flight as JSON takes it.

    Raises:
        InputError: fewer than two samples, or a position or attitude that is not finite.
    """
    if len(flight.time) < 2:
        raise InputError(f"{flight.name}: a flight of {len(flight.time)} samples, expected 2")
    for name in ("position", "velocity", "attitude"):
        if name not in flight.signals or not np.isfinite(flight[name]).all():
            raise InputError(f"{flight.name}: {name} is missing or not finite")
    flight = flight.resample()
    attitude = np.roll(flight.rotation.as_quat(), 1, axis=1)  # scalar first
    signals = [
        {"name": "position", **encoded(flight["position"])},
        {"name": "velocity", **encoded(flight["velocity"])},
        {"name": "attitude", **encoded(attitude, 1.0)},
    ]
    names = [name for name in flight.signals if name not in (*FIRST, *NOT_IN_A_STRIP)]
    for name in (*(name for name in FIRST if name in flight.signals), *names):
        for part in flight.signals[name].by_unit():
            if np.isfinite(part.values).any():
                signals.append({"name": f"strip_{len(signals) - 3}", **_strip(name, part)})
    return {
        "name": flight.name,
        "note": str(flight.source.get("note", "")),
        "crash": flight.crash or "",
        "lap_ends": _numbers(flight.lap_ends),
        "passages": [[round(t, 4), int(g), _maybe(c)] for t, g, c in flight.passages.tolist()],
        "time": _base64(flight.time.astype("<f4")),
        "signals": signals,
    }


def _strip(name: str, signal: Signal) -> dict[str, Any]:
    """A signal that is drawn over time, with its title; four speeds are those of rotors."""
    count, unit = signal.values.shape[1], str(signal.unit)
    labels = signal.labels or [str(index + 1) for index in range(count)]
    is_rotors = unit == "rpm" or (name in ("actuators", "rotor_speed") and unit == "rad/s")
    title = "body rates" if name == "rates" else name.replace("_", " ")
    if name in ("command", "actuators"):
        named = "rotor speed" if is_rotors else QUANTITIES.get(unit)
        title = f"commanded {named or 'values'}" if name == "command" else named or title
        if name == "command" and not unit and signal.labels == MOTORS:
            title = "motor command"
    about: dict[str, Any] = {"title": title, "unit": unit, "labels": list(labels)}
    if is_rotors and count == 4:
        about["turns_per_second"] = TURNS[unit]
    return about | encoded(signal.values)


def encoded(values: np.ndarray, largest: float | None = None) -> dict[str, Any]:
    """Columns (n, k) as 16-bit integers: ``offset + scale * integer``, with NaN as ``MISSING``.

    The error is at most 1/65534 of a column's range.

    Args:
        values: (n, k).
        largest: of all values; the range of each column if not given.
    """
    finite = np.where(np.isfinite(values), values, np.nan)
    if largest is None:
        empty = ~np.isfinite(finite).any(axis=0)
        filled = np.where(empty, 0.0, finite)
        low, high = np.nanmin(filled, axis=0), np.nanmax(filled, axis=0)
    else:
        low, high = (np.full(values.shape[1], sign * largest) for sign in (-1.0, 1.0))
    offset, scale = 0.5 * (low + high), np.maximum((high - low) / 65534.0, 1e-12)
    whole = np.clip(np.round((finite - offset) / scale), -32767, 32767)
    integers = np.where(np.isfinite(whole), whole, MISSING).astype("<i2")
    numbers = {"offset": offset.tolist(), "scale": scale.tolist()}
    return {**numbers, "data": _base64(integers)}


def _base64(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values).tobytes()).decode("ascii")


def _numbers(values: np.ndarray) -> list[float]:
    return [round(float(value), 6) for value in np.asarray(values).ravel()]


def _maybe(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
