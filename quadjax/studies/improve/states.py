"""What logged flights tell a training: states to start from, and the clearance that they need."""

from collections.abc import Sequence

import numpy as np

from quadjax.config.race import build_vehicle, choices_of, vehicle_model_of
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.fitting.flight_log import FlightLog
from quadjax.race.recorded_starts import States
from quadjax.studies.replay.logged import Logged, logged
from quadjax.studies.report.flights import passages
from quadjax.view.flight import clearance

RATE = 20.0  # Hz, of the states that are kept
REACH = 0.5  # m by which openings are wider where a logged position tells the gate ahead
SPREAD = 3.0  # standard deviations of the clearance at a gate that are to be free
AFTER_A_HIT = 0.05  # m, least increase of the margin
MOST = 0.2  # m, largest increase in a round


def _signals(log: FlightLog, config: Config) -> Logged | None:
    """The signals of a log; None where it has no position or attitude."""
    try:
        return logged(log, choices_of(config).model, build_vehicle(config))
    except InputError:
        return None


def states_of_logs(logs: Sequence[FlightLog], config: Config) -> States | None:
    """States of flights at ``RATE``, with the gate ahead of each.

    Logs without a position, a passage of the first gate, or propeller speeds give none; None if no
    log gives any.
    """
    parts: list[dict[str, np.ndarray]] = []
    name = vehicle_model_of(config).actuators.name
    for log in logs:
        flight = _signals(log, config)
        if flight is None or name not in flight.actuators:
            continue
        passed, targets = passages(flight.position, config.track, REACH)
        if not passed:
            continue
        rows = slice(None, None, max(1, round(1.0 / (RATE * flight.step))))
        own = {
            "position": flight.position,
            "velocity": flight.velocity,
            "euler": flight.attitude.as_euler("ZYX")[:, ::-1],
            "rates": flight.rates,
            "actuators": flight.actuators[name],
            "target": np.array(targets),
        }
        parts.append({key: values[rows] for key, values in own.items()})
    if not parts:
        return None
    arrays = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    return States(arrays, config.track.name)


def clearances(logs: Sequence[FlightLog], config: Config) -> dict[int, np.ndarray]:
    """Distances (n,) from the edge of the opening at the passages of each gate, m."""
    found: dict[int, list[float]] = {}
    for log in logs:
        flight = _signals(log, config)
        if flight is None:
            continue
        samples, targets = passages(flight.position, config.track, REACH)
        for index in samples:
            number = targets[index - 1]
            gate = config.track.gates[number]
            local = (flight.position[index] - np.array(gate.position)) @ np.array(gate.axes)
            found.setdefault(number, []).append(float(clearance(gate, local[1:])))
    return {number: np.array(values) for number, values in sorted(found.items())}


def margin_of(config: Config, logs: Sequence[FlightLog], hits: int) -> float:
    """The margin inside the gates' edges, m, that flights call for: ``reward.gate_edge_margin``.

    It grows by what ``SPREAD`` standard deviations of the clearance at a gate exceed its mean, by
    at least ``AFTER_A_HIT`` where a flight hit a gate. A reward without a penalty near the edges
    has no margin to change.

    Args:
        config: of the training before.
        logs: the flights of its policy.
        hits: number of them that hit a gate.
    """
    now = config.reward.gate_edge_margin
    if config.reward.gate_edge == 0:
        return now
    needed = [
        SPREAD * float(values.std(ddof=1)) - float(values.mean())
        for values in clearances(logs, config).values()
        if len(values) > 2
    ]
    more = max([*needed, AFTER_A_HIT if hits else 0.0, 0.0])
    half = 0.5 * min(size for gate in config.track.gates for size in gate.size)
    largest = max(now, 0.5 * (half - config.rules.body_radius))
    return round(min(now + min(more, MOST), largest), 3)
