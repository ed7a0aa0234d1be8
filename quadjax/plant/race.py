"""A policy file on the stand-in plant: put together, flown to the end, timed."""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config
from quadjax.evaluation.recording import Recording
from quadjax.plant import flight
from quadjax.plant.build import build_plant, nominal_vehicle
from quadjax.plant.ekf_params import ekf_params
from quadjax.plant.flight import FlightChoices, FlightParams, Frame
from quadjax.plant.indi import indi_params
from quadjax.plant.onboard import OnboardChoices, OnboardParams
from quadjax.plant.plant_schema import PlantConfig
from quadjax.plant.sensors import sensor_params
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot, command_ranges, make_pilot, race_of
from quadjax.race import laps
from quadjax.race.build import build_vehicle
from quadjax.race.environment import exact_rules
from quadjax.race.laps import Laps
from quadjax.vehicle import motor
from quadjax.vehicle.estimator import estimator_params

CHUNK_SECONDS = 1.0  # of flight between looks at who is still flying


@dataclasses.dataclass(frozen=True)
class Flights:
    """Flights that are over.

    Attributes:
        laps: the timed result.
        frames: of the first runs: time first, runs last; as NumPy arrays.
        step: s between frames.
    """

    laps: Laps
    frames: Frame
    step: float


@dataclasses.dataclass(frozen=True)
class Plan:
    """Flights ready to be flown."""

    choices: FlightChoices
    params: FlightParams
    pilot: Pilot
    step: float  # s, of the control loop
    limit: int  # control steps after which a flight is out of time
    laps: int
    runs: int


def plan_flights(
    config: Config,
    plant: PlantConfig,
    policy: Policy,
    name: str = "policy",
    lap_count: int = 6,
    runs: int = 100,
    recorded: int = 5,
    deterministic: bool = True,
) -> Plan:
    """Flights of a policy on the plant.

    Args:
        config: of the race, whose vehicle (with its residual) the drone's computers believe in;
            whether it is the motor-level or the rate-level one is the policy's.
        plant: of the plant.
        policy: a policy file's content.
        name: the file, for messages.
        lap_count: to fly, from hover.
        runs: drones, each by itself.
        recorded: of how many what is flown is kept.
        deterministic: fly the mean, as an autopilot does, rather than samples.

    Raises:
        InputError: a policy that does not fit, or files that cannot be read.
    """
    config = race_config(config, policy)
    choices, params = race_of(config, policy)
    params = exact_rules(choices.model, params)
    pilot = make_pilot(config, policy, command_ranges(choices, params), deterministic, name)
    hold = round(plant.sample_rate / plant.control_rate)
    own = FlightChoices(
        choices,
        OnboardChoices(plant.navigation, plant.disturbance_input),
        hold,
        min(recorded, runs),
    )
    charge = tuple(jnp.float32(x) for x in plant.battery.charge)
    numbers = FlightParams(build_plant(plant), params, _carried(config, plant), charge)
    limit = round(laps.time_limit(params.track, lap_count) * plant.control_rate)
    return Plan(own, numbers, pilot, 1.0 / plant.control_rate, limit, lap_count, runs)


def race_config(config: Config, policy: Policy) -> Config:
    """The race for one policy: its kind of vehicle, no random changes, and its disturbances' scale.

    The disturbance is estimated on board of the plant, so that the race itself has none.
    """
    widths = policy.observation.get("disturbance") or {}
    known = {key: value for key, value in widths.items() if key in vars(config.disturbance)}
    return dataclasses.replace(
        config,
        vehicle=dataclasses.replace(config.vehicle, kind=policy.vehicle, actual={}),
        disturbance=dataclasses.replace(config.disturbance, **known),
        randomise=type(config.randomise)(),
        episode=dataclasses.replace(config.episode, disturbance_input="true"),
    )


def _carried(config: Config, plant: PlantConfig) -> OnboardParams:
    """Sensors, filters and inner loop; the model they know is the config's motor-level vehicle."""
    rate = plant.sample_rate
    believed = dataclasses.replace(
        config, vehicle=dataclasses.replace(config.vehicle, kind="motor")
    )
    model = build_vehicle(believed)
    gravity = float(model.constants.g)
    return OnboardParams(
        sensors=sensor_params(plant.sensors, rate),
        ekf=ekf_params(plant.sensors, plant.ekf, rate, gravity),
        estimator=estimator_params(motor.MODEL, model, rate),
        inner=indi_params(nominal_vehicle(plant).motor, plant.indi, rate),
    )


def fly_plan(
    plan: Plan, seed: int = 0, report: Callable[[float], None] = lambda seconds: None
) -> Flights:
    """Fly until every drone has finished or crashed.

    Args:
        plan: what is flown.
        seed: of batteries, gusts, sensors and the policy's noise.
        report: told how many seconds of flight are done.
    """
    start, key = jax.random.split(jax.random.key(seed))
    drones = jax.jit(flight.begin, static_argnums=(0, 3, 4))(
        plan.choices, plan.params, start, plan.runs, plan.laps
    )
    chunk = max(1, round(CHUNK_SECONDS / plan.step))
    kept: list[Frame] = []
    for number in range(-(-plan.limit // chunk)):
        own = jax.random.fold_in(key, number)
        drones, frames = flight.fly_on(plan.choices, chunk, plan.params, plan.pilot, drones, own)
        kept.append(jax.tree.map(np.asarray, frames))
        report((number + 1) * chunk * plan.step)
        if bool(jnp.all(drones.race.over)):
            break
    joined = jax.tree.map(lambda *parts: np.concatenate(parts), *kept)
    result = laps.laps_of(drones.race, float(plan.params.plant.step), plan.limit * plan.step)
    return Flights(result, joined, plan.step)


def recordings(flights: Flights) -> list[Recording]:
    """The recorded runs as what figures are made of, each cut where it ended."""
    frames, result = flights.frames, []
    for run in range(frames.over.shape[-1]):
        going = ~frames.over[:, run]
        count = int(going.sum())

        def rows(vector: object, count: int = count, run: int = run) -> np.ndarray:
            columns = [np.asarray(x)[:count, run] for x in jax.tree.leaves(vector)]
            return np.stack(columns, axis=1).astype(np.float64)

        times = flights.laps.lap_times[run]
        true = frames.true
        result.append(
            Recording(
                flights.step * np.arange(count),
                rows(true.position),
                rows(true.velocity),
                rows(true.euler),
                rows(true.rates),
                rows(true.rpm),
                rows(frames.command),
                np.cumsum(times[np.isfinite(times)]),
                flights.laps.crashes[run],
            )
        )
    return result
