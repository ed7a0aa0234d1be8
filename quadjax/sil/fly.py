"""One race of an autopilot: states go out, commands come back, the drone moves on.

In lock-step the drone waits for the command of every state that arrived, so that a race does not
depend on the machine. In real time a state goes out in every period; a command that arrives within
it acts from its beginning, a later one in the period in which it arrives.
"""

import dataclasses
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

from quadjax.flights.flight import SIMULATED, Flight, simulated_flight
from quadjax.race.laps import Laps
from quadjax.race.track import GateSection
from quadjax.sil.faults import Channel, Faults
from quadjax.sil.message import RPM_PER_RAD_S, STATE_FIELDS, CommandKind, Kind, new
from quadjax.sil.peer import Gone, Peer
from quadjax.sil.worlds import Now, World, command_kind

INTERRUPTED, LOST = "interrupted", "autopilot gone"
MARGIN = 1e-5  # of a command's range, by which rounding may exceed it
FLOATS = [name for name, kind, _, _ in STATE_FIELDS if kind == "<f4"]


@dataclasses.dataclass(frozen=True)
class Timing:
    """How the simulation keeps time."""

    speed: float | None = None  # times real time; None: lock-step, as fast as possible
    timeout: float = 5.0  # s without any answer, after which an autopilot counts as gone


@dataclasses.dataclass
class Race:
    """One race that has ended, or was interrupted."""

    flight: Flight
    laps: Laps
    counts: dict[str, int]  # of steps and messages
    gone: Gone | None = None


@dataclasses.dataclass
class _Flight:
    """A race under way."""

    world: World
    peer: Peer
    timing: Timing
    run: int
    to_autopilot: Channel
    from_autopilot: Channel
    held: np.ndarray  # command in the model's units
    counts: Counter[str] = dataclasses.field(default_factory=Counter)
    accepted: int = -1  # newest state that the autopilot accepted
    answered: int = -1  # newest state whose command was received
    applied: int = -1  # newest state whose command was applied
    last: np.ndarray | None = None  # newest command message
    answered_at: float = dataclasses.field(default_factory=time.monotonic)  # when it was received

    def step(self, now: Now, number: int, until: float | None) -> None:
        """Exchange the messages of a step; ``held`` is then the command that acts in it.

        Args:
            now: the drone.
            number: of the step.
            until: end of the period, ``time.monotonic()``; None in lock-step.

        Raises:
            Gone: the autopilot is gone or silent.
        """
        at = number * self.world.step
        state = _state(now, self.run, number, at)
        state["lock_step"] = self.timing.speed is None
        self.to_autopilot.push(state, at)
        for sent in self.to_autopilot.due(at):
            self.peer.send(sent.data)
            if sent.intact and sent.sequence > self.accepted:
                self.accepted = sent.sequence
        self._receive(until, at)
        before = self.applied
        for sent in self.from_autopilot.due(at):
            self._apply(sent.data, sent.intact)
        self.counts["steps"] += 1
        self.counts["held steps"] += int(self.applied == before)

    def _receive(self, until: float | None, at: float) -> None:
        """Wait for the command of the newest state that was accepted."""
        start = time.monotonic()
        limit = start + self.timing.timeout if until is None else until
        while self.answered < self.accepted:
            message = self.peer.receive(limit)
            if message is None:
                break
            if message["run"] == self.run and message["sequence"] > self.answered:
                self.answered, self.answered_at = int(message["sequence"]), time.monotonic()
                self.from_autopilot.push(np.array(message), at)
            else:
                self.peer.rejected["another step or race"] += 1
        if self.answered == self.accepted or self.peer.stopped:
            return
        if until is None or start - self.answered_at > self.timing.timeout:
            raise self.peer.gone(f"has not answered within {self.timing.timeout:g} s")
        self.counts["late steps"] += 1

    def _apply(self, data: bytes, intact: bool) -> None:
        """Take over a command, unless it is rejected."""
        if not intact:
            self.peer.rejected["wrong checksum"] += 1
            return
        message = np.frombuffer(data, new(Kind.COMMAND).dtype)[0]
        kind = command_kind(self.world.model)
        if message["sequence"] <= self.applied:
            self.peer.rejected["out of date"] += 1
        elif message["command_kind"] != kind or not np.isfinite(message["command"]).all():
            self.peer.rejected["not finite, or of another kind"] += 1
        else:
            factor = RPM_PER_RAD_S if kind is CommandKind.ROTOR_SPEEDS_RAD_S else 1.0
            wanted = message["command"].astype(np.float64) * factor
            low, high = self.world.ranges()
            margin = MARGIN * (high - low)
            outside = np.any((wanted < low - margin) | (wanted > high + margin))
            self.counts["clipped commands"] += int(outside)
            self.held = np.clip(wanted, low, high).astype(np.float32)
            self.applied, self.last = int(message["sequence"]), message


def set_floats(state: np.ndarray, numbers: np.ndarray) -> None:
    """Set all floats of a state's message, in order."""
    start = 0
    for name in FLOATS:
        size = state[name].size
        state[name] = numbers[start : start + size].reshape(state[name].shape)
        start += size


def _state(now: Now, run: int, number: int, at: float) -> np.ndarray:
    """The message of a state."""
    message = new(Kind.STATE, run, number, at)
    set_floats(message, now.numbers)
    message["target_gate"] = now.target
    return message


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
    peer: Peer,
    faults: Faults,
    timing: Timing,
    seed: int,
    run: int,
    stop: threading.Event,
    report: Callable[[float], None] = lambda seconds: None,
    gates: Sequence[GateSection] = (),
) -> Race:
    """Fly one race.

    Args:
        world: the drone.
        peer: the autopilot.
        faults: of the link.
        timing: lock-step, or a speed.
        seed: of the world and of the faults.
        run: number of the race, in the messages.
        stop: ends the race, whose record so far is kept.
        report: called every second of flight with the elapsed seconds.
        gates: of the track, for the record.
    """
    now = world.begin(seed + run)
    there, back = (Channel(faults, seed + run, stream) for stream in (0, 1))
    flight = _Flight(world, peer, timing, run, there, back, resting(world, now))
    clock, rows, gone = _Clock(world.step, timing.speed), list[np.ndarray](), None
    peer.rejected.clear()
    for number in range(world.limit):
        if now.over or stop.is_set():
            break
        if number and number % round(1.0 / world.step) == 0:
            report(number * world.step)
        try:
            flight.step(now, number, clock.begin(number))
        except Gone as error:
            gone = error
            break
        rows.append(np.concatenate([now.true, flight.held, [now.target]]))
        now = world.advance(now, flight.held)
    flight.counts["slow steps"] = clock.slow
    result = world.result(now)
    if not now.over and (stop.is_set() or gone):
        result = dataclasses.replace(result, crashes=(INTERRUPTED if stop.is_set() else LOST,))
    size = len(now.true)
    parts = np.split(np.reshape(rows, (-1, size + 5)), [3, 6, 9, 12, size, size + 4], axis=1)
    values = dict(zip((*SIMULATED, "target"), parts, strict=True))
    ends = (result.lap_times[0], result.crashes[0])
    name, step = f"run {run + 1}", world.step
    record = simulated_flight(name, step, values, gates, world.model, *ends)
    return Race(record, result, _counts(flight), gone)


class _Clock:
    """Starts of the periods in real time."""

    def __init__(self, step: float, speed: float | None) -> None:
        self._period = step / speed if speed else None
        self._start = time.monotonic()
        self.slow = 0  # periods that began late, because this machine was too slow

    def begin(self, number: int) -> float | None:
        """Wait for the start of a period, and return its end; None in lock-step."""
        if self._period is None:
            return None
        behind = time.monotonic() - (self._start + number * self._period)
        if behind > self._period:
            self.slow += 1
            self._start += behind
        elif behind < 0:
            time.sleep(-behind)
        return self._start + (number + 1) * self._period


def _counts(flight: _Flight) -> dict[str, int]:
    """What happened to steps and messages; zeros are left out, except for the steps."""
    counts = dict(flight.counts)
    for name, channel in (("states", flight.to_autopilot), ("commands", flight.from_autopilot)):
        counts |= {f"{name} {what}": n for what, n in channel.counts.items() if what != "sent"}
    counts |= {f"commands rejected: {why}": n for why, n in flight.peer.rejected.items()}
    if flight.last is not None:
        names = ("rejected_messages", "nan_steps", "clipped_steps", "outside_steps")
        counts |= {f"autopilot: {name.replace('_', ' ')}": int(flight.last[name]) for name in names}
        rejected = int(flight.last["rejected_messages"])  # since the autopilot started
        counts["autopilot: rejected messages"] = rejected - flight.peer.rejected_before
        flight.peer.rejected_before = rejected
    return {name: n for name, n in counts.items() if n or name == "steps"}
