"""Drones that differ from their model: the policy needs the estimate of the disturbance."""

import pytest

from quadjax.config.loading import load_config
from quadjax.core.resources import PRETRAINED
from quadjax.policy.file import Policy
from quadjax.studies.adaptation import CONDITIONS, Condition, fly_condition

RACE = load_config("e2e +residual", ["evaluate.laps=6"])
YAW = next(each for each in CONDITIONS if each.label == "yaw moment -0.01 N m")


def test_a_condition_changes_the_simulated_drone_only():
    race = Condition("", (0.01, 0.0, 0.0), thrust=0.96, residual=2.0).race(RACE)
    assert race.vehicle.mismatch == {"k_w": 0.96} and race.vehicle.residual_gain == 2.0
    assert race.disturbance.moment_bias == (0.01, 0.0, 0.0)
    assert race.vehicle.constants == RACE.vehicle.constants
    assert Condition("", residual=0.0).race(RACE).vehicle.residual is None
    assert Condition("").race(RACE) == RACE


@pytest.mark.slow
def test_only_the_policy_with_the_estimate_finishes_under_a_steady_moment():
    adaptive, without = (Policy.load(PRETRAINED / f"{x}.npz") for x in ("e2e_adaptive", "e2e"))
    fly = {"deterministic": True, "runs": 2}
    assert fly_condition(RACE, YAW, adaptive, "estimated", **fly).finished == 2
    assert fly_condition(RACE, YAW, adaptive, "none", **fly).finished == 0
    assert fly_condition(RACE, YAW, without, "none", **fly).finished == 0


@pytest.mark.slow
def test_only_the_policy_with_the_estimate_finishes_with_a_damaged_rotor():
    rotor = next(each for each in CONDITIONS if each.label.startswith("rotor 1"))
    adaptive, without = (Policy.load(PRETRAINED / f"{x}.npz") for x in ("e2e_adaptive", "e2e"))
    fly = {"deterministic": True, "runs": 2}
    assert fly_condition(RACE, rotor, adaptive, "estimated", **fly).finished == 2
    assert fly_condition(RACE, rotor, without, "none", **fly).finished == 0
