"""A drone without physics, and an autopilot that is a Python function."""

import dataclasses

import numpy as np

from quadjax.export.library import FLYING, LOST, VEHICLE
from quadjax.race.laps import Laps
from quadjax.sil.drones import DroneState, SimulatedDrone
from quadjax.sil.run import make_drone
from quadjax.vehicle import rate

STEPS = 40
SHORT = 150  # steps


def short_drone(*arguments) -> SimulatedDrone:
    """As ``sil.run.make_drone``; races end after ``SHORT`` steps."""
    drone = make_drone(*arguments)
    return dataclasses.replace(drone, limit=min(SHORT, drone.limit))


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
        vehicle, motion = np.zeros((), VEHICLE), np.full(3, float(number))
        vehicle["position"] = number
        true = dict.fromkeys(("position", "velocity", "attitude", "rates"), motion)
        true |= {"actuators": np.float32(number)}
        return DroneState(number, vehicle, true, number % 4, number >= STEPS)

    def result(self, now):
        done = now.over
        laps = np.array([[now.state * self.step if done else np.nan]])
        return Laps(laps, ("" if done else "out of time",), np.array([now.state * self.step]), 10.0)


class Autopilot:
    """In place of the C: a command that tells the step of the state, with a thrust."""

    label, files = "a function", ""

    def __init__(
        self,
        reply=lambda number: (number / 100.0, 0.0, 0.0, 9.0),
        statuses=lambda number: FLYING,
    ):
        self._reply, self._statuses, self.replies = reply, statuses, {}

    def begin(self):
        self.seen = []  # times of the calls, and positions of their states

    def step(self, now_us, vehicle):
        if vehicle is None:
            self.seen.append((now_us, None))
            return LOST, np.zeros(4, np.float32)
        self.seen.append((now_us, int(vehicle["position"][0])))
        status = self._statuses(self.seen[-1][1])
        return status, np.float32(self.replies.get(status) or self._reply(self.seen[-1][1]))

    def counts(self):
        return {"nan calls": 0, "outside steps": len(self.seen)}

    def outside(self):
        return ["rates[0]"]

    def signals(self):
        return {}
