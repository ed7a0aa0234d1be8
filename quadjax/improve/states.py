"""What logged flights tell a training: states to start from, and the clearance that they need."""

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np
from scipy.stats import chi2

from quadjax.config.race import build_vehicle, choices_of
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.fitting.flight_log import FlightLog
from quadjax.flights.flight import MOTION, Flight, Signal
from quadjax.flights.gates import crossing_after_end, passages
from quadjax.log_states import vehicle_flight

STATES = 1024  # that are kept: with one number, all trainings are one compiled program
REACH = 0.5  # m by which openings are wider where a logged position tells the gate ahead
BEFORE = 0.1  # s before a gate's plane at which a flight may end and still count as its passage
SPREAD = 4.0  # standard deviations of the clearance that are to be free
UNSURE = 0.1  # probability that the standard deviation is larger than assumed
AFTER_A_HIT = 0.05  # m, least increase of the margin
MOST = 0.2  # m, largest increase in a round


def _flight(log: FlightLog, config: Config) -> Flight | None:
    """A log as a flight with its passages, whose end is none; None without position or attitude."""
    try:
        flight = vehicle_flight(log, choices_of(config).model, build_vehicle(config))
    except InputError:
        return None
    gates, closed = config.track.gates, config.track.closed
    path = flight.time, flight["position"]
    passed = passages(*path, gates, reach=REACH, closed=closed, cut=False)
    return flight.replace(gates=gates, passages=passed)


def states_of_logs(logs: Sequence[FlightLog], config: Config) -> Flight | None:
    """``STATES`` states at even intervals of the flights, with the gate ahead of each.

    Logs without a position, a passage of the first gate, or propeller speeds give none; None if no
    log gives any.
    """
    flights = [flight for log in logs if (flight := _flight(log, config)) is not None]
    flights = [f for f in flights if len(f.passages) and "actuators" in f.signals]
    if not flights:
        return None
    signals = {}
    for name in (*MOTION, "actuators"):
        values = np.concatenate([flight[name] for flight in flights])
        signals[name] = dataclasses.replace(flights[0].signals[name], values=values)
    target = np.concatenate([flight.target for flight in flights])
    signals["target"] = Signal(target[:, None].astype(np.float64))
    rows = np.linspace(0, len(target) - 1, STATES).round().astype(int)
    whole = Flight("states", np.arange(len(target), dtype=np.float64), signals)
    return whole.map(lambda values: values[rows]).replace(time=np.arange(STATES, dtype=float))


def clearances(
    logs: Sequence[FlightLog], config: Config, hit: Collection[str] = ()
) -> dict[int, np.ndarray]:
    """Distances (n,) from the edge of the opening at the passages of each gate, m.

    Args:
        logs: of the flights.
        config: of the race.
        hit: names of the logs that end at a gate. This end is a passage too, with the position at
            the plane of the gate, so its distance is negative or nearly zero.
    """
    found: dict[int, list[float]] = {}
    for log in logs:
        flight = _flight(log, config)
        if flight is None:
            continue
        gates, passed = flight.gates, flight.passages
        distances = [(int(number), float(clear)) for _, number, clear in passed]
        if log.name in hit:
            ahead = len(passed) % len(gates)
            end = crossing_after_end(flight.time, flight["position"], gates[ahead], BEFORE)
            distances += [] if end is None else [(ahead, end[1])]
        for number, clear in distances:
            found.setdefault(number, []).append(clear)
    return {number: np.array(values) for number, values in sorted(found.items())}


def spread_of(found: dict[int, np.ndarray]) -> float:
    """Standard deviation of clearances around the mean of their gate, m, as an upper bound.

    With few passages it is larger than the estimate, by the distribution of a variance: smaller
    than the true one only with a probability of ``UNSURE``. NaN without a second passage.
    """
    squares = sum(float(((values - values.mean()) ** 2).sum()) for values in found.values())
    free = sum(len(values) - 1 for values in found.values())
    return float(np.sqrt(squares / chi2.ppf(UNSURE, free))) if free > 0 else float("nan")


def margin_of(config: Config, logs: Sequence[FlightLog], hit: Collection[str], hits: int) -> float:
    """The margin inside the gates' edges, m, that flights call for: ``reward.gate_edge_margin``.

    It grows by what ``SPREAD`` standard deviations of the clearance exceed its mean at the gate
    with the smallest mean, by at least ``AFTER_A_HIT`` where a flight hit a gate. A reward without
    a penalty near the edges has no margin to change.

    Args:
        config: of the training before.
        logs: the flights of its policy.
        hit: names of the logs that end at a gate.
        hits: number of flights that hit a gate; the checks of logs may reject some.
    """
    now = config.reward.gate_edge_margin
    if config.reward.gate_edge == 0:
        return now
    found = clearances(logs, config, hit)
    least = min((float(values.mean()) for values in found.values()), default=np.inf)
    needed = SPREAD * spread_of(found) - least
    more = max(needed if np.isfinite(needed) else 0.0, AFTER_A_HIT if hits else 0.0, 0.0)
    half = 0.5 * min(size for gate in config.track.gates for size in gate.size)
    largest = max(now, 0.5 * (half - config.rules.body_radius))
    return round(min(now + min(more, MOST), largest), 3)
