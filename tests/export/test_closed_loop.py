"""Whole races through every autopilot's glue, with lost and late states, under sanitizers."""

import dataclasses
import threading
from pathlib import Path

import pytest

from quadjax.core.resources import PRETRAINED
from quadjax.export.race_source import policy_race
from quadjax.export.verify import autopilot
from quadjax.plant.config import load_plant_config
from quadjax.policy.file import Policy
from quadjax.policy.race import race_of_policy
from quadjax.sil import run
from quadjax.sil.faults import Faults
from quadjax.sil.run import Setting, fly_all
from tests.export.support import converted_in

RACER = Path(__file__).parent / "racer.npz"  # of the 5-inch drone: no rotor speeds, a history
PERIOD = 0.002  # s, of the plant's control loop
SANITIZERS = "-std=c99 -fsanitize=address,undefined -fno-sanitize-recover=all -g -O1".split()
GLUES = {  # policy, target, and whether it flies on the plant
    "paparazzi": (PRETRAINED / "e2e_residual_disturbance.npz", "cortex-a9", True),
    "paparazzi, rates": (PRETRAINED / "indi.npz", "cortex-a9", True),
    "indiflight": (RACER, "indiflight", False),
    "px4": (RACER, "px4", False),
    "crazyflie": (RACER, "crazyflie", False),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", GLUES)
def test_a_whole_race_through_the_glue(name, tmp_path, monkeypatch):
    """``tests/sil`` flies races of a build without sanitizers."""
    path, target, on_plant = GLUES[name]
    compiler = dataclasses.replace(autopilot.host(), flags=tuple(SANITIZERS))
    monkeypatch.setattr(autopilot, "host", lambda: compiler)
    faults = Faults(drop=0.1, late=0.1, delay=PERIOD if on_plant else 5 * PERIOD)
    policy = Policy.load(path)
    config, origin = race_of_policy(policy)
    converted = converted_in(tmp_path, policy, policy_race(config, policy, origin), target, 512.0)
    monkeypatch.setattr(run, "read_folder", lambda *_: converted)
    plant = load_plant_config("standin") if on_plant else None
    flown = fly_all(Setting(tmp_path, plant, laps=1, faults=faults), threading.Event())
    assert flown.races[0].gone is None and flown.laps.crashes == ("",), flown.text()
    assert ("its own estimator" in flown.autopilot) == (name == "paparazzi")
    assert "autopilot: nan steps" not in flown.counts and "in the glue of" in flown.sources
