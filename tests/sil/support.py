"""A drone without physics, and an autopilot that is a Python function."""

import dataclasses

import numpy as np

from quadjax.race.laps import Laps
from quadjax.sil.run import make_world
from quadjax.sil.worlds import Now, World
from quadjax.vehicle import rate

STEPS = 40
SHORT = 150  # steps


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

    def constants(self):
        return {}

    def ranges(self):
        return np.array([-3.0, -3.0, -3.0, 0.0]), np.array([3.0, 3.0, 3.0, 15.0])

    def begin(self, seed):
        return self.at(0)

    def advance(self, now, command):
        return self.at(now.state + 1)

    def at(self, number):
        numbers = np.arange(36, dtype=np.float32) + number
        return Now(number, numbers, number % 4, np.full(13, float(number)), number >= STEPS)

    def result(self, now):
        done = now.over
        laps = np.array([[now.state * self.step if done else np.nan]])
        return Laps(laps, ("" if done else "out of time",), np.array([now.state * self.step]), 10.0)


class Autopilot:
    """In place of the C: a command that tells the step of the state, with a thrust."""

    label, files = "a function", ""

    def __init__(self, reply=lambda number: (number / 100.0, 0.0, 0.0, 9.0)):
        self._reply = reply

    def begin(self):
        self.seen = []  # steps of the states, by their times and by their positions

    def step(self, time, state):
        self.seen.append((round(time / Counting.step), int(state["position"][0])))
        return np.float32(self._reply(self.seen[-1][0]))

    def counts(self):
        return {"nan steps": 0, "clipped steps": len(self.seen)}
