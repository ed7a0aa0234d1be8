"""Whole races through every autopilot's glue, with lost and late states, and under sanitizers."""

import dataclasses
import threading
from pathlib import Path

import pytest

from quadjax.core.resources import PRETRAINED
from quadjax.export.race_source import own_race
from quadjax.export.verify import autopilot
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.sil import run
from quadjax.sil.faults import Faults
from quadjax.sil.run import Setting, fly_all
from tests.export.support import converted_in
from tests.export.test_runtime import SANITIZERS

RACER = Path(__file__).parent / "racer.npz"  # of the 5-inch drone: no rotor speeds, a history
PLANT = load_plant_config("standin")
PERIOD = 0.002  # s, of the plant's control loop
FAULTS = {
    "lockstep": Faults(),
    "lost": Faults(drop=0.2),
    "late by a period": Faults(late=0.2, delay=PERIOD),
    "late by two": Faults(late=0.2, delay=2 * PERIOD),
}
GLUES = {  # policy, target, and whether it flies on the plant
    "paparazzi": (PRETRAINED / "e2e_adaptive.npz", "cortex-a9", True),
    "paparazzi, rates": (PRETRAINED / "indi_shac.npz", "cortex-a9", True),
    "indiflight": (RACER, "indiflight", False),
    "px4": (RACER, "px4", False),
    "crazyflie": (RACER, "crazyflie", False),
}


def flown(name, folder, monkeypatch, faults):
    """One lap in the glue of a target."""
    path, target, on_plant = GLUES[name]
    policy = Policy.load(path)
    config, origin = race_of_policy(policy)
    converted = converted_in(folder, policy, own_race(config, policy, origin), target, 512.0)
    monkeypatch.setattr(run, "read_folder", lambda *_: converted)
    if not on_plant and faults.late:  # the simulator's period is longer
        faults = dataclasses.replace(faults, delay=5 * faults.delay)
    setting = Setting(folder, PLANT if on_plant else None, laps=1, faults=faults)
    found = fly_all(setting, threading.Event())
    assert found.races[0].gone is None and found.laps.crashes == ("",), found.text()
    assert ("its own estimator" in found.autopilot) == (name == "paparazzi")
    assert "autopilot: nan steps" not in found.counts
    return found


@pytest.mark.slow
@pytest.mark.parametrize("name, faults", zip(GLUES, [*FAULTS, "lost"], strict=True))
def test_a_whole_race_through_the_glue(name, faults, tmp_path, monkeypatch):
    """One kind of faults for each glue; the races under sanitizers have both."""
    found = flown(name, tmp_path, monkeypatch, FAULTS[faults])
    assert "in the glue of" in found.sources


@pytest.mark.slow
@pytest.mark.parametrize("name", GLUES)
def test_a_whole_race_under_sanitizers(name, tmp_path, monkeypatch):
    compiler = dataclasses.replace(autopilot.host(), flags=tuple(SANITIZERS))
    monkeypatch.setattr(autopilot, "host", lambda: compiler)
    flown(name, tmp_path, monkeypatch, Faults(drop=0.1, late=0.1, delay=PERIOD))
