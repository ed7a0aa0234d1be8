"""One race of exported C: each step sends a state, gets a command, simulates the drone."""

import dataclasses
import threading
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from quadjax.flights.flight import SIMULATED, Flight, simulated_flight
from quadjax.race.laps import Laps
from quadjax.race.track import GateSection
from quadjax.sil.faults import RPM_PER_RAD_S, Channel, Faults, Sent
from quadjax.sil.source import ExportedC
from quadjax.sil.worlds import Now, World

INTERRUPTED = "interrupted"
MARGIN = 1e-5  # of a command's range, by which rounding may exceed it


@dataclasses.dataclass
class Race:
    """One race that has ended, or was interrupted."""

    flight: Flight
    laps: Laps
    counts: dict[str, int]  # of steps, states and commands


@dataclasses.dataclass
class _Flight:
    """A race in progress."""

    world: World
    autopilot: ExportedC
    states: Channel
    commands: Channel
    held: np.ndarray  # command in the model's units
    counts: Counter[str] = dataclasses.field(default_factory=Counter)
    seen: int = -1  # newest state that the autopilot has
    applied: int = -1  # newest state whose command was applied

    def step(self, now: Now, number: int) -> None:
        """Exchange the state and command of a step; ``held`` is then its command."""
        step, before = self.world.step, self.applied
        self.states.push(now.vehicle, number, number * step)
        for sent in self.states.due(number * step):
            if sent.number <= self.seen:
                self.counts["states rejected: out of date"] += 1
                continue
            self.seen = sent.number
            command = self.autopilot.step(sent.number * step, sent.data)
            self.commands.push(command, sent.number, number * step)
        for sent in self.commands.due(number * step):
            self._apply(sent)
        self.counts["steps"] += 1
        self.counts["held steps"] += int(self.applied == before)

    def _apply(self, sent: Sent) -> None:
        """Apply a command, unless a newer one was applied."""
        if sent.number <= self.applied:
            self.counts["commands rejected: out of date"] += 1
            return
        factor = RPM_PER_RAD_S if self.world.model.commands[0].unit == "rpm" else 1.0
        wanted = sent.data.astype(np.float64) * factor
        low, high = self.world.ranges()
        margin = MARGIN * (high - low)
        outside = np.any((wanted < low - margin) | (wanted > high + margin))
        self.counts["clipped commands"] += int(outside)
        self.held = np.clip(wanted, low, high).astype(np.float32)
        self.applied = sent.number

    def all_counts(self) -> dict[str, int]:
        """What happened to steps, states and commands; zeros are left out, but for the steps."""
        counts = dict(self.counts)
        for name, channel in (("states", self.states), ("commands", self.commands)):
            counts |= {f"{name} {what}": n for what, n in channel.counts.items()}
        counts |= {f"autopilot: {name}": n for name, n in self.autopilot.counts().items()}
        return {name: n for name, n in counts.items() if n or name == "steps"}


def resting(world: World, now: Now) -> np.ndarray:
    """The command before the first one arrives: hover, or halfway between the limits."""
    low, high = world.ranges()
    if world.model.name == "rate":
        return np.array([0.0, 0.0, 0.0, 9.81], np.float32)
    if world.model.actuators.name == world.model.commands[0].name:
        return now.true[12:].astype(np.float32)
    return (0.5 * (low + high)).astype(np.float32)


def fly(
    world: World,
    autopilot: ExportedC,
    faults: Faults,
    seed: int,
    stop: threading.Event,
    report: Callable[[float], None] = lambda seconds: None,
    gates: Sequence[GateSection] = (),
    name: str = "run 1",
) -> Race:
    """Fly one race.

    The simulation waits for every command, so a race does not depend on the computer's speed.

    Args:
        world: the drone.
        autopilot: the C.
        faults: of the link.
        seed: of the world and of the faults.
        stop: ends the race, whose record so far is kept.
        report: called every second of flight with the elapsed seconds.
        gates: of the track, for the record.
        name: of the record.
    """
    now = world.begin(seed)
    channels = Channel(faults, seed, 0), Channel(faults.of_commands, seed, 1)
    flight = _Flight(world, autopilot, *channels, resting(world, now))
    autopilot.begin()
    rows = list[np.ndarray]()
    for number in range(world.limit):
        if now.over or stop.is_set():
            break
        if number and number % round(1.0 / world.step) == 0:
            report(number * world.step)
        flight.step(now, number)
        rows.append(np.concatenate([now.true, flight.held, [now.target]]))
        now = world.advance(now, flight.held)
    result = world.result(now)
    if not now.over and stop.is_set():
        result = dataclasses.replace(result, crashes=(INTERRUPTED,))
    size = len(now.true)
    parts = np.split(np.reshape(rows, (-1, size + 5)), [3, 6, 9, 12, size, size + 4], axis=1)
    values = dict(zip((*SIMULATED, "target"), parts, strict=True))
    ends = (result.lap_times[0], result.crashes[0])
    record = simulated_flight(name, world.step, values, gates, world.model, *ends)
    return Race(record, result, flight.all_counts())
