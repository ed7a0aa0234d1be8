"""Flights on the stand-in plant of the race that a config describes."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.config.loading import stored_config
from quadjax.config.race import build_vehicle, race_of
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.plant.config import PlantConfig
from quadjax.plant.flights import Plan, plan_flights
from quadjax.policy.file import Policy
from quadjax.policy.pilot import fit_race

PARTS = ("vehicle", "track", "battery")  # sections of a stored config that describe the drone


def plan_race(
    config: Config, plant: PlantConfig, policy: Policy, name: str = "policy", **options: int | bool
) -> Plan:
    """Flights of a policy on the plant.

    Args:
        config: of the race; its vehicle, with its residual, is the onboard model.
        plant: of the plant.
        policy: a policy file's content.
        name: of the policy file, for messages.
        **options: of ``plan_flights``.

    Raises:
        InputError: a policy that does not fit, or files that cannot be read.
    """
    race = fit_race(*race_of(race_config(config, policy)), policy, name)
    onboard = build_vehicle(config.replace(vehicle=config.vehicle.with_model("motor")))
    return plan_flights(race, onboard, plant, policy, **options)


def race_config(config: Config, policy: Policy) -> Config:
    """The race of one policy: its vehicle model, without disturbances and randomization.

    The vehicle has the constants that the policy was trained with, where its file has them, so that
    its commands have their meaning. On the plant the disturbance is that of the plant, estimated on
    board; the race adds none.
    """
    vehicle = config.vehicle.with_model(policy.vehicle)
    battery = config.battery
    if policy.config is not None:
        parts = {key: policy.config[key] for key in PARTS if key in policy.config}
        own = stored_config(parts, "policy file")
        vehicle, battery = vehicle.replace(constants=own.vehicle.constants), own.battery
    return config.replace(
        vehicle=vehicle.replace(mismatch={}),
        battery=battery,
        disturbance=type(config.disturbance)(),
        randomization=type(config.randomization)(),
        observation=config.observation.replace(disturbance="ground_truth", highest_rpm="estimated"),
    )


def plan_logs(
    config: Config, plant: PlantConfig, policies: Sequence[Path | str], flights: int, laps: int
) -> dict[str, Plan]:
    """Flights of several policy files, by the names of their logs, with a record of each sample.

    Arguments and errors as of ``plan_race``.
    """
    plant = plant.replace(control_rate=plant.sample_rate)
    options = {"lap_count": laps, "runs": flights, "recorded": flights}
    plans = {
        Path(file).stem: plan_race(config, plant, Policy.load(file), str(file), **options)
        for file in policies
    }
    if len(plans) < len(policies):
        raise InputError(f"two of the policies have the same name: {', '.join(map(str, policies))}")
    return plans


def gate_centers(config: Config) -> np.ndarray:
    """Centers (gates, 3) of a config's track, m, world."""
    return np.array([gate.position for gate in config.track.gates], np.float64)
