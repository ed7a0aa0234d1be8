"""Flights on the stand-in plant of the race that a config describes."""

from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from quadjax.config.loading import stored_config
from quadjax.config.race import build_vehicle, race_of
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.plant.build import build_plant
from quadjax.plant.config import PlantConfig
from quadjax.plant.flight import Plan
from quadjax.plant.onboard import onboard_params
from quadjax.policy.file import Policy
from quadjax.policy.pilot import fit_race, make_pilot
from quadjax.race.environment import exact_rules
from quadjax.race.laps import time_limit
from quadjax.vehicle.battery import middle_limit

PARTS = ("vehicle", "track", "battery")  # sections of a stored config that describe the drone


def plan_race(
    config: Config,
    plant: PlantConfig,
    policy: Policy,
    name: str = "policy",
    *,
    lap_count: int = 6,
    runs: int = 100,
    recorded: int = 5,
    deterministic: bool = True,
) -> Plan:
    """Flights of a policy on the plant.

    Args:
        config: of the race; its vehicle, with its residual, is the onboard model.
        plant: of the plant.
        policy: a policy file's content.
        name: of the policy file, for messages.
        lap_count: laps, from hover.
        runs: number of independent drones.
        recorded: runs whose frames are kept.
        deterministic: apply the mean action rather than samples.

    Raises:
        InputError: a policy that does not fit, or files that cannot be read.
    """
    choices, params = fit_race(*race_of(race_config(config, policy)), policy, name)
    params = exact_rules(choices.model, params)
    model = build_vehicle(config.replace(vehicle=config.vehicle.with_model("motor")))
    first_limit = None if params.battery is None else middle_limit(params.battery)
    low, high = plant.battery.charge
    return Plan(
        plant=build_plant(plant),
        race=params,
        onboard=onboard_params(plant, model, first_limit),
        pilot=make_pilot(choices, params, policy, deterministic),
        charge=(jnp.float32(low), jnp.float32(high)),
        choices=choices,
        step=1.0 / plant.control_rate,
        hold=round(plant.sample_rate / plant.control_rate),
        limit=round(time_limit(params.track, lap_count) * plant.control_rate),
        laps=lap_count,
        runs=runs,
        recorded=min(recorded, runs),
    )


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
    plans = {}
    for file in policies:
        plans[Path(file).stem] = plan_race(
            config,
            plant,
            Policy.load(file),
            str(file),
            lap_count=laps,
            runs=flights,
            recorded=flights,
        )
    if len(plans) < len(policies):
        raise InputError(f"two of the policies have the same name: {', '.join(map(str, policies))}")
    return plans


def gate_centers(config: Config) -> np.ndarray:
    """Centers (gates, 3) of a config's track, m, world."""
    return np.array([gate.position for gate in config.track.gates], np.float64)
