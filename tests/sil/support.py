"""A drone without physics, and autopilots in a thread."""

import contextlib
import dataclasses
import socket
import threading

import numpy as np

from quadjax.race.laps import Laps
from quadjax.sil.message import CommandKind, Kind, MessageError, new, pack, unpack
from quadjax.sil.peer import ADDRESS, greeted, listening
from quadjax.sil.worlds import Now
from quadjax.vehicle import rate

STEPS = 40


@dataclasses.dataclass(frozen=True)
class Counting:
    """A drone whose position is the number of the step, and whose race ends after ``STEPS``."""

    name: str = "counting"
    model = rate.MODEL
    step: float = 0.01
    limit: int = 1000

    def ranges(self):
        return np.array([-3.0, -3.0, -3.0, 0.0]), np.array([3.0, 3.0, 3.0, 15.0])

    def begin(self, seed):
        return self.at(0)

    def advance(self, now, command):
        return self.at(now.state + 1)

    def at(self, number):
        numbers = np.arange(40, dtype=np.float32) + number
        return Now(number, numbers, number % 4, np.full(13, float(number)), number >= STEPS)

    def result(self, now):
        done = now.over
        laps = np.array([[now.state * self.step if done else np.nan]])
        return Laps(laps, ("" if done else "out of time",), np.array([now.state * self.step]), 10.0)


def answer(state):
    """Rates that tell the step, and a thrust."""
    command = new(Kind.COMMAND, int(state["run"]), int(state["sequence"]), float(state["time_s"]))
    command["command_kind"] = CommandKind.RATES_RAD_S_AND_THRUST_M_S2
    command["command"] = [float(state["sequence"]) / 100.0, 0.0, 0.0, 9.0]
    return command


def hello(kind=CommandKind.RATES_RAD_S_AND_THRUST_M_S2, mismatches=0):
    message = new(Kind.HELLO)
    message["command_kind"], message["self_test_mismatches"] = kind, mismatches
    return message


def autopilot(port, reply, first=None):
    """Answer states by ``reply(state) -> messages`` until the end, or until it returns None."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as own:
        own.settimeout(20.0)
        own.connect((ADDRESS, port))
        own.send(pack(hello()) if first is None else first)
        with contextlib.suppress(OSError):
            while True:
                try:
                    state = unpack(own.recv(4096))
                except MessageError:
                    continue
                replies = reply(state) if state["kind"] == Kind.STATE else None
                if replies is None:
                    return
                for data in replies:
                    own.send(data)


@contextlib.contextmanager
def connected(reply, first=None, stop=None):
    """A peer whose autopilot runs in a thread."""
    stop = stop or threading.Event()
    with listening(ADDRESS, 0) as own:
        thread = threading.Thread(
            target=autopilot, args=(own.getsockname()[1], reply, first), daemon=True
        )
        thread.start()
        kind = CommandKind.RATES_RAD_S_AND_THRUST_M_S2
        with greeted(own, kind, 20.0, stop) as peer:
            yield peer
        thread.join(20.0)
