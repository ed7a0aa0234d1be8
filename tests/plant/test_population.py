"""A population: drones by their numbers, in one simulation."""

import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.plant.flights import fly_plan, plan_race
from quadjax.policy.file import Policy

OWN = """
base: plant/exact
population:
  motors.tau: [0.03, 0.06]
  delay.command: [0.004, 0.001]
  effects.inflow: [0.5, 0.5]
"""


@pytest.fixture
def own(tmp_path):
    path = tmp_path / "own.yaml"
    path.write_text(OWN)
    return load_plant_config(path)


def test_a_drone_has_its_values(own):
    first, second, third = map(own.member, range(3))
    assert (first.motors.tau, second.motors.tau) == (0.03, 0.06)
    assert (second.delay.command, second.effects.inflow) == (0.001, 0.5)
    assert not first.population and first.constants.seed == own.constants.seed
    # After the last one: the same numbers, other constants.
    assert third == first.replace(constants=first.constants.replace(seed=own.constants.seed + 1))
    assert own.replace(drone=1).member(0) == second
    seeds = [PlantConfig().member(number).constants.seed for number in range(3)]
    assert seeds == [1, 2, 3]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            "motors.tau: [0.03]",
            "population.motors.tau has 1 values, population.effects.gusts 2; allowed: one for each",
        ),
        ("motors.lags: [0.03, 0.06]", "population.motors.lags: .*unknown key"),
        (
            "motors.tau: [0.03, -1.0]",
            r"/bad.yaml: population.motors.tau, drone 1: motors.tau is -1, allowed: greater than 0",
        ),
        ("inner_loop: [1, 2]", "population.inner_loop, drone 0: inner_loop is 1, allowed: 'indi'"),
        ("wind.speed: [1, 2]", "wind"),
        ("name.x: [1, 2]", "name"),
        ("effects.flex: [1, 1]\ndrone: 2", "bad.yaml: drone is 2, allowed: 0 to 1, the drones of"),
    ],
)
def test_what_is_no_population_is_refused(tmp_path, change, message):
    path = tmp_path / "bad.yaml"
    text = OWN.replace("motors.tau: [0.03, 0.06]", "effects.gusts: [0.0, 0.0]")
    path.write_text(f"{text}  {change}\n")
    with pytest.raises(InputError, match=message):
        load_plant_config(path)


def plan(plant, drones, runs):
    race = load_config("e2e", ["network.hidden=[8]"])
    options = {"lap_count": 1, "runs": runs, "drones": drones, "deterministic": True}
    return plan_race(race, plant, Policy.load("e2e"), **options)


def test_only_numbers_that_differ_are_of_each_run(own):
    made = plan(own, 2, 4)
    np.testing.assert_allclose(made.plant.vehicle.constants.tau, [0.03, 0.06] * 2)
    np.testing.assert_allclose(made.plant.command_delay, [2.0, 0.5] * 2)
    assert made.plant.effects.inflow.shape == made.plant.vehicle.constants.k_w.shape == ()
    assert made.plant.commands_waiting == 2 and sum(made.differ) == 3  # tau is twice there
    assert not any(plan(own, 1, 2).differ)


@pytest.mark.slow  # compiles the plant
def test_drones_of_one_simulation_fly_as_each_alone(own):
    together = fly_plan(plan(own, 2, 2)).laps.totals
    alone = [fly_plan(plan(own.member(number), 1, 1)).laps.totals[0] for number in range(2)]
    assert abs(together[0] - together[1]) > 0.005
    np.testing.assert_allclose(together, alone, atol=0.001)
