"""One race of an autopilot on a simulated drone: a state, a call, a control step."""

import dataclasses
import threading
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from quadjax.export.library import FLYING, LOST
from quadjax.flights.flight import SIMULATED, Flight, simulated_flight
from quadjax.race.laps import Laps
from quadjax.race.track import GateSection
from quadjax.sil.autopilot import Autopilot
from quadjax.sil.drones import DroneState, SimulatedDrone
from quadjax.sil.faults import Channel, Faults

INTERRUPTED = "interrupted"


@dataclasses.dataclass
class FlightResult:
    """One race that has ended, or was interrupted."""

    flight: Flight
    laps: Laps
    counts: dict[str, int]  # of steps and states
    outside: list[str]  # inputs of the policy that were outside their range


def resting(drone: SimulatedDrone, now: DroneState) -> np.ndarray:
    """The command before the first one of the autopilot: hover, or halfway between the limits."""
    low, high = drone.ranges()
    if drone.model.name == "rate":
        return np.array([0.0, 0.0, 0.0, 9.81], np.float32)
    if drone.model.actuators.name == drone.model.commands[0].name:
        return now.true["actuators"].astype(np.float32)
    return (0.5 * (low + high)).astype(np.float32)


def fly(
    drone: SimulatedDrone,
    autopilot: Autopilot,
    faults: Faults,
    seed: int,
    stop: threading.Event,
    report: Callable[[float], None] = lambda seconds: None,
    gates: Sequence[GateSection] = (),
    name: str = "run 1",
) -> FlightResult:
    """Fly one race.

    The simulation waits for every command, so a race does not depend on the computer's speed.

    Args:
        drone: what is flown.
        autopilot: what flies.
        faults: of the states.
        seed: of the drone and of the faults.
        stop: ends the race, whose record so far is kept.
        report: called every second of flight with the elapsed seconds.
        gates: of the track, for the record.
        name: of the record.
    """
    now, channel, counts = drone.begin(seed), Channel(faults, seed), Counter[str]()
    held, flying, (low, high) = resting(drone, now), False, drone.ranges()
    sizes = {key: np.size(x) for key, x in now.true.items()} | {"command": 4, "target": 1}
    rows: dict[str, list[np.ndarray]] = {key: [] for key in (*SIMULATED, "target")}
    autopilot.begin()
    for number in range(drone.limit):
        if now.over or stop.is_set():
            break
        if number and number % round(1.0 / drone.step) == 0:
            report(number * drone.step)
        state, now_us = now.vehicle.copy(), round(1e6 * number * drone.step)
        state["time_us"] = state["position_us"] = now_us
        state["autopilot_command"] = held
        status, command = autopilot.step(now_us, channel.newest(state, number * drone.step))
        flying = flying or status == FLYING
        if flying:  # zeros of a pilot that has lost the state are the lowest commands
            held = np.clip(command, low, high).astype(np.float32)
        counts["steps"] += 1
        counts["steps without a state"] += int(flying and status == LOST)
        values = {**now.true, "command": held, "target": np.array(now.target)}
        for key, value in values.items():
            rows[key].append(value)
        now = drone.advance(now, held)
    result = drone.result(now)
    if not now.over and stop.is_set():
        result = dataclasses.replace(result, crashes=(INTERRUPTED,))
    values = {key: np.reshape(row, (len(row), sizes[key])) for key, row in rows.items()}
    ends = (result.lap_times[0], result.crashes[0])
    record = simulated_flight(name, drone.step, values, gates, drone.model, *ends)
    record = record.replace(signals=record.signals | autopilot.signals())
    for prefix, found in (("states ", channel.counts), ("autopilot: ", autopilot.counts())):
        counts.update({f"{prefix}{key}": count for key, count in found.items()})
    found = {key: count for key, count in counts.items() if count or key == "steps"}
    return FlightResult(record, result, found, autopilot.outside())
