"""Where a path passes the gates of a track."""

from collections.abc import Sequence

import numpy as np

from quadjax.race.track import GateSection

MEASURED_MARGIN_M = 0.1  # of openings for positions that were measured
SAME_GATE_M = 1e-4  # between gates of one track
LAST_GATE_S = 0.05  # a path may end so long before its last gate, whose passage ended the flight


def clearance(gate: GateSection, place: np.ndarray) -> np.ndarray:
    """Distance (..) from the edge of a gate's opening, m, negative outside.

    ``place`` (.., 2) is along its width and its height, from its center, m.
    """
    if gate.shape == "circle":
        return 0.5 * gate.size[0] - np.linalg.norm(place, axis=-1)
    return (0.5 * np.array(gate.size) - np.abs(place)).min(axis=-1)


def is_same_track(gates: Sequence[GateSection], others: Sequence[GateSection]) -> bool:
    """Whether gates are those of another track, within ``SAME_GATE_M``."""
    one, two = (
        np.array([[*gate.position, *np.ravel(gate.axes), *gate.size] for gate in track])
        for track in (gates, others)
    )
    return one.shape == two.shape and np.allclose(one, two, atol=SAME_GATE_M)


def passages(
    time: np.ndarray,
    position: np.ndarray,
    gates: Sequence[GateSection],
    *,
    reach: float = 0.0,
    target: np.ndarray | None = None,
    closed: bool = True,
    cut: bool = True,
) -> np.ndarray:
    """Where a path passes the gates, in their order.

    A path passes the gate ahead where the straight line between two samples crosses its plane from
    behind, within the opening. The path may end up to ``LAST_GATE_S`` before the plane of the gate
    ahead, as does the record of a flight that this passage ended: its last velocity then gives time
    and place.

    Args:
        time: (n,) s.
        position: (n, 3) m, world.
        gates: of the track, in order of passage; none are passed if it is empty.
        reach: m by which openings are wider.
        target: (n,) index of the gate to pass next, by the rules of the race, which then decide
            what is a passage; None, or with a single gate: the openings decide.
        closed: whether the first gate follows the last one.
        cut: whether the path may end before its last passage.

    Returns:
        (k, 3): time, s; index of the gate; distance from the edge of its opening, m, negative
        outside.
    """
    if not gates or len(time) < 2:
        return np.zeros((0, 3))
    if target is not None and len(gates) > 1:
        rows = _by_target(time, position, gates, target.astype(int))
        ahead = int(target[-1])
    else:
        rows = _in_order(time, position, gates, reach, closed)
        ahead = len(rows) % len(gates)
    if cut and (closed or len(rows) < len(gates)):
        end = _crossing_after_end(time, position, gates[ahead])
        if end is not None and end[1] >= -reach:
            rows.append((*end, ahead))
    return np.array(rows, np.float64).reshape(-1, 3)[:, [0, 2, 1]]


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


def _by_target(
    time: np.ndarray, position: np.ndarray, gates: Sequence[GateSection], target: np.ndarray
) -> list[tuple[float, float, int]]:
    """Time, clearance and gate of each passage by the targets (n,), of which one step may skip."""
    rows: list[tuple[float, float, int]] = []
    for sample in np.flatnonzero(target[1:] != target[:-1]):
        number, next_number = int(target[sample]), int(target[sample + 1])
        while True:
            crossing = _crossings(time, position, gates[number], np.array([sample]))[0]
            rows.append((*crossing, number))
            number = (number + 1) % len(gates)
            before, after = _ahead(position[sample : sample + 2], gates[number])
            if number == next_number or not before < 0 <= after:
                break
    return rows


def _ahead(position: np.ndarray, gate: GateSection) -> np.ndarray:
    """How far positions (n, 3) are beyond a gate's plane (n,), m."""
    return (position - np.array(gate.position)) @ np.array(gate.axes)[:, 0]


def _in_order(
    time: np.ndarray, position: np.ndarray, gates: Sequence[GateSection], reach: float, closed: bool
) -> list[tuple[float, float, int]]:
    """Time, clearance and gate of each passage through the openings, widened by ``reach``."""
    passages = []
    for gate in gates:
        ahead = _ahead(position, gate)
        (samples,) = np.nonzero((ahead[:-1] < 0) & (ahead[1:] >= 0))
        crossings = _crossings(time, position, gate, samples)
        inside = crossings[:, 1] >= -reach
        passages.append(crossings[inside])
    rows: list[tuple[float, float, int]] = []
    last = len(position) if closed else len(gates)
    when = -np.inf
    while len(rows) < last:
        number = len(rows) % len(gates)
        first = int(np.searchsorted(passages[number][:, 0], when, side="right"))
        if first == len(passages[number]):
            break
        when = passages[number][first, 0]
        rows.append((*passages[number][first], number))
    return rows


def _crossings(
    time: np.ndarray, position: np.ndarray, gate: GateSection, samples: np.ndarray
) -> np.ndarray:
    """Time and clearance (k, 2) where the lines from samples (k,) to the next cross a plane."""
    axes, center = np.array(gate.axes), np.array(gate.position)
    before, after = ((position[rows] - center) @ axes for rows in (samples, samples + 1))
    fraction = -before[:, 0] / np.maximum(after[:, 0] - before[:, 0], 1e-12)
    fraction = np.clip(fraction, 0.0, 1.0)
    place = before + fraction[:, None] * (after - before)
    when = time[samples] + fraction * (time[samples + 1] - time[samples])
    return np.stack([when, clearance(gate, place[:, 1:])], axis=1)


def _crossing_after_end(
    time: np.ndarray, position: np.ndarray, gate: GateSection
) -> tuple[float, float] | None:
    """Time and clearance at which a path that ends before a gate's plane would cross it.

    The velocity is the mean over the last ``LAST_GATE_S`` of the path. None if the path would
    take longer to the plane.
    """
    first = min(int(np.searchsorted(time, time[-1] - LAST_GATE_S)), len(time) - 2)
    axes = np.array(gate.axes)
    velocity = (position[-1] - position[first]) / (time[-1] - time[first]) @ axes
    place = (position[-1] - np.array(gate.position)) @ axes
    if not 0.0 < -place[0] <= LAST_GATE_S * velocity[0]:
        return None
    left = -place[0] / velocity[0]
    return float(time[-1] + left), float(clearance(gate, (place + left * velocity)[1:]))
