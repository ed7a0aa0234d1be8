"""Races on a plant: both policies, their observations, and their logs."""

import dataclasses
from pathlib import Path

import jax
import numpy as np
import pytest

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.resources import CONFIGS, PRETRAINED
from quadjax.plant import flight as onboard_flight
from quadjax.plant.config import PlantConfig, load_plant_config
from quadjax.plant.flights import (
    extract_rows,
    fly_plan,
    log_quantities,
    plan_race,
    race_config,
    recorded_flights,
)
from quadjax.policy.file import Policy
from quadjax.race.layout import LAST_ACTION
from quadjax.training.build import untrained_policy
from quadjax.vehicle.registry import MODELS
from tests.evaluation.support import random_policy

PLANT = load_plant_config(CONFIGS / "plant" / "standin.yaml")
DRONE = Path(__file__).parents[2] / "examples" / "03_drone.yaml"
EXACT = PLANT.replace(navigation="ground_truth")


def flown(name: str, plant: PlantConfig):
    config = load_config("e2e +residual")
    policy = Policy.load(PRETRAINED / name)
    plan = plan_race(config, plant, policy, name, lap_count=1, runs=2, recorded=2)
    return config, fly_plan(plan, seed=3)


@pytest.fixture(scope="module")
def e2e():
    return flown("e2e_residual.npz", PLANT)


@pytest.fixture(scope="module")
def indi():
    return flown("indi.npz", EXACT)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["e2e", "indi"])
def test_a_policy_flies_a_lap_by_its_estimates(name, request):
    """Close to the true position and not equal: of the ground truth, one sample late."""
    race, flights = request.getfixturevalue(name)
    assert flights.laps.lap_times.shape == (2, 1)
    assert flights.laps.crashes == ("", "")
    assert ((flights.laps.totals > 2.0) & (flights.laps.totals < 5.0)).all()
    gates, model = load_config("e2e").track.gates, MODELS[{"e2e": "motor", "indi": "rate"}[name]]
    for flight in recorded_flights(flights, gates, model):
        assert flight["actuators"].shape[1] == model.actuators.size
        assert flight["command"].shape[1] == 4
        last_gate = [-2.0, -1.5, -1.5]
        assert np.linalg.norm(flight["position"][-1] - last_gate) < 1.0
        np.testing.assert_array_equal(flight.passages[:, 1], [0, 1, 2, 3])
        assert flight.passages[-1, 0] == pytest.approx(flight.lap_ends[0], abs=0.01)
    estimated = extract_rows(flights, flights.frames.estimate.motion.position, 0)
    error = np.abs(estimated - extract_rows(flights, flights.frames.true.position, 0))
    assert 1e-5 < error.mean() < 0.05 and error.max() < 0.1
    centers = np.array([gate.position for gate in race.track.gates])
    log = log_quantities(flights, 0, centers)
    np.testing.assert_array_equal(log["position"], estimated)
    np.testing.assert_allclose(log["target_gate"][0], centers[0])


def test_the_race_is_the_policys_own():
    config = load_config("e2e +residual")
    policy = Policy.load(PRETRAINED / "indi_fastest.npz")
    race = race_config(config, policy)
    assert race.vehicle.model == "rate" and race.observation.disturbance == "ground_truth"
    limits = load_config("indi", ["vehicle.constants.thrust_max=20"])
    own = dataclasses.replace(policy, config=limits.model_dump(mode="json", by_alias=True))
    assert race_config(config, own).vehicle.constants["thrust_max"] == 20.0
    widths = random_policy(widths={"moment_x": 0.03})
    assert not any(race_config(config, widths).disturbance.half_widths.values())


def test_a_policy_of_another_drone_is_refused():
    config = load_config("e2e", [f"vehicle={DRONE}"])
    policy = untrained_policy(config)
    with pytest.raises(InputError, match="Parrot Bebop 1, .* 7497 rpm.* 12500 rpm; .*vehicle"):
        plan_race(config, PLANT, policy)
    plan_race(config, PLANT.replace(vehicle=str(DRONE)), policy)
    heavy = load_config("e2e", ["vehicle.constants.k_w=3.5e-8"])  # by a quarter
    plan_race(heavy, PLANT, untrained_policy(heavy))
    weak = load_config("e2e", ["vehicle.constants.i_xx=0.003"])
    with pytest.raises(InputError, match="another drone"):
        plan_race(weak, PLANT, untrained_policy(weak))


def with_last_action(plant):
    """A race of a policy that observes its last action."""
    config = load_config("e2e", ["observation.last_action=true", "network.hidden=[8]"])
    return plan_race(config, plant, untrained_policy(config), "own", lap_count=1, runs=2)


def test_steps_of_another_length_than_in_training_are_refused():
    plan = with_last_action(EXACT.replace(control_rate=500.0))
    with pytest.raises(InputError, match="of 0.01 s, .* steps are 0.002 s: add control_rate=100"):
        fly_plan(plan)


@pytest.mark.slow  # compiles the plant
def test_the_last_action_is_the_command_of_the_step_before():
    plan = with_last_action(EXACT)
    drones, kept = onboard_flight.begin(plan, jax.random.key(0)), []
    for key in jax.random.split(jax.random.key(1), 4):
        before, (drones, frame) = drones, onboard_flight.advance(plan, 1, drones, key)
        kept.append(
            (before.race.state.memories[LAST_ACTION], jax.tree.map(lambda x: x[0], frame.command))
        )
    action, command = jax.tree.map(lambda *x: np.stack(x), *kept)
    low, high = (np.asarray(end)[:, None] for end in plan.race.ranges.commanded)
    given = 2.0 * (np.stack(jax.tree.leaves(command), 1) - low) / (high - low) - 1.0
    assert not np.any(np.stack(action, 1)[0])
    np.testing.assert_allclose(np.stack(action, 1)[1:], given[:-1], atol=1e-5)
