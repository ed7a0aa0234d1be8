"""A drone without physics, and autopilots in a thread."""

import contextlib
import dataclasses
import socket
import threading

import numpy as np

from quadjax.race.laps import Laps
from quadjax.sil.message import CommandKind, Kind, MessageError, new, pack, unpack
from quadjax.sil.peer import ADDRESS, greeted, listening
from quadjax.sil.run import make_world
from quadjax.sil.worlds import Now, World
from quadjax.vehicle import rate

STEPS = 40
SHORT = 150  # steps
RATES = CommandKind.RATES_RAD_S_AND_THRUST_M_S2


def short_world(*arguments) -> World:
    """As ``sil.run.make_world``; races end after ``SHORT`` steps."""
    world = make_world(*arguments)
    return dataclasses.replace(world, limit=min(SHORT, world.limit))


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


def answer(state, **changes):
    """Rates that tell the step, and a thrust; fields of the message may be changed."""
    command = new(Kind.COMMAND, int(state["run"]), int(state["sequence"]), float(state["time_s"]))
    command["command_kind"] = RATES
    command["command"] = [float(state["sequence"]) / 100.0, 0.0, 0.0, 9.0]
    for name, value in changes.items():
        command[name] = value
    return pack(command)


def hello(kind=RATES, mismatches=0):
    message = new(Kind.HELLO)
    message["command_kind"], message["self_test_mismatches"] = kind, mismatches
    return pack(message)


def autopilot(port, reply, first):
    """Answer states by ``reply(state) -> messages`` until the end."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link, contextlib.suppress(OSError):
        link.settimeout(20.0)
        link.connect((ADDRESS, port))
        link.send(first)
        while True:
            with contextlib.suppress(MessageError):
                state = unpack(link.recv(4096))
                if state["kind"] != Kind.STATE:
                    return
                for data in reply(state):
                    link.send(data)


@contextlib.contextmanager
def connected(reply, first, stop):
    """A peer whose autopilot runs in a thread."""
    with listening(ADDRESS, 0) as link:
        address = link.getsockname()[1]
        thread = threading.Thread(target=autopilot, args=(address, reply, first), daemon=True)
        thread.start()
        with greeted(link, RATES, 20.0, stop) as peer:
            yield peer
        thread.join(20.0)
