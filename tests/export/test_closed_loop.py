"""Whole races through every autopilot's glue, with lost and late states, and under sanitizers."""

import dataclasses
import threading
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from quadjax.core.resources import PRETRAINED
from quadjax.export.race_source import own_race
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.sil import source
from quadjax.sil.faults import Faults
from quadjax.sil.fly import Timing, fly
from quadjax.sil.message import RPM_PER_RAD_S, Kind, new, pack, unpack
from quadjax.sil.run import Setting, fly_all, make_world
from quadjax.sil.worlds import command_kind
from tests.export.test_pilot import Crazyflie, Indiflight, Paparazzi, Px4
from tests.export.test_runtime import SANITIZERS
from tests.sil.test_exported import written

RACER = Path(__file__).parent / "racer.npz"  # of the 5-inch drone: no rotor speeds, a history
PLANT = load_plant_config("standin")
PERIOD = 0.002  # s, of the plant's control loop
FAULTS = {
    "lockstep": Faults(),
    "lost": Faults(drop=0.2),
    "late by a period": Faults(late=0.2, delay=PERIOD),
    "late by two": Faults(late=0.2, delay=2 * PERIOD),
}
DELAYS = {"lockstep": (0,), "lost": (1000,), "late": (1, 2)}  # periods, of a fifth of the states


class Bebop(Paparazzi):
    """Paparazzi's module at 500 Hz, one call for each state of the plant."""

    calls = 1

    def build(self):
        header = self.folder / "paparazzi/quadjax_policy.h"
        header.write_text(
            header.read_text().replace("QUADJAX_FREQUENCY 512", "QUADJAX_FREQUENCY 500")
        )
        return super().build()


class Peer:
    """The glue behind the messages, called in every period with the newest state that has come."""

    def __init__(self, glue, world, delays):
        self.glue, self.world, self.kind = glue, world, command_kind(world.model)
        self.rejected, self.rejected_before, self.stopped = Counter(), 0, False
        self._random, self._delays, self._answers = np.random.default_rng(0), delays, []
        self._rows, self._newest = {}, (-1, None)
        glue.step(np.zeros(22), flying=False)

    def send(self, data):
        state = unpack(data)
        number = int(state["sequence"])
        late = self._random.uniform() < 0.2 and self._newest[1] is not None
        self._rows[number + (int(self._random.choice(self._delays)) if late else 0)] = (
            number,
            self._row_of(state),
        )
        come = self._rows.pop(number, self._newest)
        fresh = come[0] > self._newest[0]
        self._newest = come if fresh else self._newest
        command = new(Kind.COMMAND, int(state["run"]), number, float(state["time_s"]))
        command["command_kind"] = self.kind
        unit = RPM_PER_RAD_S if self.world.model.name == "motor" else 1.0
        stale, row = {}, self._newest[1]
        if isinstance(self.glue, Px4) and not fresh:  # the rates are a topic apart
            stale, row[9:12] = {"lost": 8}, state["rates_frd_rad_s"]
        command["command"] = self.glue.step(row, **stale) / unit
        self._answers.append(command)

    def _row_of(self, state):
        rotors = state["rotor_speed_rad_s"].astype(float)
        rotors = rotors * (RPM_PER_RAD_S if isinstance(self.glue, Paparazzi) else 1.0)
        if self.world.model.name == "rate":
            rotors = np.array([float(state["thrust_m_s2"]), 0.0, 0.0, 0.0])
        motion = ("position_ned_m", "velocity_ned_m_s", "attitude_rpy_rad", "rates_frd_rad_s")
        row = np.concatenate([*(state[name] for name in motion), rotors])
        if isinstance(self.glue, Paparazzi) and self.world.model.name == "motor":
            row = np.concatenate([row, state["specific_force_frd_m_s2"], state["velocity_frd_m_s"]])
        return row

    def receive(self, limit):
        return unpack(pack(self._answers.pop(0))) if self._answers else None


def race_of(name):
    policy = Policy.load(name)
    config, origin = race_of_policy(policy)
    return policy, config, own_race(config, policy, origin)


GLUES = {  # policy, target, glue, and whether it flies on the plant
    "paparazzi": (PRETRAINED / "e2e_adaptive.npz", "cortex-a9", Bebop, True),
    "paparazzi, rates": (PRETRAINED / "indi_shac.npz", "cortex-a9", Bebop, True),
    "indiflight": (RACER, "indiflight", Indiflight, False),
    "px4": (RACER, "px4", Px4, False),
    "crazyflie": (RACER, "crazyflie", Crazyflie, False),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", GLUES)
def test_a_whole_race_through_the_glue(name, tmp_path):
    path, target, kind, on_plant = GLUES[name]
    policy, config, own = race_of(path)
    glue = kind(target, policy, own, tmp_path)
    assert not glue.wrong
    laps = 1 if policy.vehicle == "motor" else config.evaluate.laps
    world = make_world(config, policy, PLANT if on_plant else None, laps)
    for faults, delays in DELAYS.items():
        peer = Peer(glue, world, delays)
        race = fly(world, peer, Faults(), Timing(), 0, 0, threading.Event())
        assert race.laps.crashes == ("",), (faults, race.laps, race.counts)
        if on_plant:  # what the ground sees: it flew, and passed all gates but the last
            seen = glue.telemetry()
            assert seen[0] == 0 and seen[1] == 1 and seen[4] >= laps * len(config.track.gates) - 1
            assert seen[6] > 0 and seen[8] == 0 and seen[13] < 0.01 * seen[6]


@pytest.mark.slow
@pytest.mark.parametrize("faults", FAULTS)
def test_a_whole_race_of_the_pilot_under_sanitizers(faults, tmp_path, monkeypatch):
    policy, config, own = race_of(PRETRAINED / "e2e_adaptive.npz")
    inputs = written(tmp_path, policy, own, config, "qjp")
    monkeypatch.setattr("quadjax.sil.run.read_inputs", lambda *_: inputs)
    compiler = dataclasses.replace(source.host(), flags=tuple(SANITIZERS))
    monkeypatch.setattr(source, "host", lambda: compiler)
    setting = Setting(tmp_path, PLANT, laps=1, faults=FAULTS[faults])
    flown = fly_all(setting, threading.Event())
    assert flown.races[0].gone is None and flown.laps.crashes == ("",), flown.text()
    assert "its own estimator" in flown.autopilot
