"""The data of a page: gates and flights as JSON, with signals as base64 of 16-bit integers."""

import base64
import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.errors import InputError
from quadjax.view.flight import TURNS, Flight, Gate, Marker

FORMAT = "quadjax-flights/1"
MISSING = -32768  # of a 16-bit integer: no value
ARM, ROTOR = 0.12, 0.076  # m, center to rotor and radius of a rotor, of a Bebop


@dataclasses.dataclass(frozen=True)
class Scene:
    """Flights on one track.

    Attributes:
        title: of the page.
        gates: in order of passage.
        flights: started together.
        markers: lap times for comparison.
        arm: distance from the drone's center to a rotor, m.
        rotor: radius of a rotor, m.
    """

    title: str
    gates: tuple[Gate, ...]
    flights: tuple[Flight, ...]
    markers: tuple[Marker, ...] = ()
    arm: float = ARM
    rotor: float = ROTOR

    def record(self) -> dict[str, Any]:
        """The scene as JSON takes it; the format is described in ``docs/reference/files.md``.

        Raises:
            InputError: no flight, or one of fewer than two samples.
        """
        if not self.flights:
            raise InputError("no flight to show")
        return {
            "format": FORMAT,
            "title": self.title,
            "gates": [gate_record(gate) for gate in self.gates],
            "drone": self.drone(),
            "flights": [flight_record(flight) for flight in self.flights],
            "markers": [marker.record() for marker in self.markers],
        }

    def drone(self) -> dict[str, float]:
        """Sizes of the drone as JSON takes them."""
        return {"arm": self.arm, "rotor": self.rotor}


def gate_record(gate: Gate) -> dict[str, Any]:
    """A gate as JSON takes it: center, axes (9,) by rows, size, shape."""
    axes = np.array(gate.axes, np.float64).ravel()
    return {
        "position": _numbers(np.array(gate.position)),
        "axes": _numbers(axes),
        "size": _numbers(np.array(gate.size)),
        "shape": gate.shape,
    }


def flight_record(flight: Flight) -> dict[str, Any]:
    """A flight as JSON takes it.

    Raises:
        InputError: fewer than two samples, or a position that is not finite.
    """
    flight = flight.resampled()
    if len(flight.time) < 2:
        raise InputError(f"{flight.name}: a flight of {len(flight.time)} samples, expected 2")
    if not np.isfinite(flight.position).all():
        raise InputError(f"{flight.name}: a position is not finite")
    attitude = np.roll(flight.attitude.as_quat(), 1, axis=1)  # scalar first
    signals = [
        {"name": "position", **encoded(flight.position)},
        {"name": "velocity", **encoded(flight.velocity)},
        {"name": "attitude", **encoded(attitude, 1.0)},
    ]
    for index, each in enumerate(flight.strips):
        own: dict[str, Any] = {"title": each.title, "unit": each.unit, "labels": list(each.labels)}
        if each.rotors:
            own["turns_per_second"] = TURNS[each.unit]
        signals.append({"name": f"strip_{index}", **own, **encoded(each.values)})
    return {
        "name": flight.name,
        "note": flight.note,
        "crash": flight.crash,
        "lap_ends": _numbers(flight.lap_ends),
        "passages": [[round(t, 4), int(g), _maybe(c)] for t, g, c in flight.passages.tolist()],
        "time": _base64(flight.time.astype("<f4")),
        "signals": signals,
    }


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
        shown = np.where(empty, 0.0, finite)
        low, high = np.nanmin(shown, axis=0), np.nanmax(shown, axis=0)
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


def check_record(path: Path | str, record: dict[str, Any]) -> dict[str, Any]:
    """A record of a file, checked to have what the page reads.

    Raises:
        InputError: another format, a missing key or one of another type.
    """
    if record.get("format") != FORMAT:
        raise InputError(f"{path}: format is {record.get('format')!r}, expected {FORMAT}")
    kinds = {"title": str, "gates": list, "flights": list, "markers": list, "drone": dict}
    for key, kind in kinds.items():
        if not isinstance(record.get(key), kind):
            raise InputError(f"{path}: {key} is missing or not a {kind.__name__}")
    keys = ("name", "time", "signals", "lap_ends", "passages")
    for index, flight in enumerate(record["flights"]):
        missing = [key for key in keys if not isinstance(flight, dict) or key not in flight]
        if missing:
            raise InputError(f"{path}: flights[{index}] has no {missing[0]}")
    return record
