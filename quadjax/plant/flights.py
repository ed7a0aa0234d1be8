"""Timed flights of a policy file on the stand-in plant."""

import dataclasses
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.flights import flight as recorded
from quadjax.plant import flight
from quadjax.plant.build import build_plant, nominal_vehicle
from quadjax.plant.config import PlantConfig
from quadjax.plant.ekf_params import ekf_params
from quadjax.plant.flight import Flight, FlightChoices, FlightParams, Frame, Record, Recorder
from quadjax.plant.indi import indi_params
from quadjax.plant.onboard import OnboardChoices, OnboardParams
from quadjax.plant.sensors import sensor_params
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot, make_pilot
from quadjax.race import laps
from quadjax.race.environment import Choices, RaceParams, exact_rules
from quadjax.race.laps import Laps
from quadjax.race.layout import Layout
from quadjax.race.track import GateSection
from quadjax.vehicle import motor
from quadjax.vehicle.battery import limit_estimator, middle_limit
from quadjax.vehicle.estimator import estimator_params
from quadjax.vehicle.protocol import VehicleModel, VehicleParams
from quadjax.vehicle.rate import RateCommand

CHUNK_SECONDS = 1.0  # of flight between checks for the end
SAME_STEP = 1e-6  # relative difference of time steps that count as equal


@dataclasses.dataclass(frozen=True)
class Flights:
    """Flights that have ended.

    Attributes:
        laps: the timed result.
        frames: of the recorded runs: time first, runs last, NumPy arrays.
        step: s between frames.
    """

    laps: Laps
    frames: Frame
    step: float


@dataclasses.dataclass(frozen=True)
class Plan:
    """Flights before the start."""

    choices: FlightChoices
    params: FlightParams
    pilot: Pilot
    step: float  # s, of the control loop
    limit: int  # control steps, after which a flight is out of time
    laps: int
    runs: int
    recorded: int  # runs, the first ones, whose frames are kept


def plan_flights(
    race: tuple[Choices, RaceParams],
    onboard: VehicleParams,
    plant: PlantConfig,
    policy: Policy,
    lap_count: int = 6,
    runs: int = 100,
    recorded: int = 5,
    deterministic: bool = True,
) -> Plan:
    """Flights of a policy on the plant.

    Args:
        race: with the observation of the policy, as ``policy.pilot.fit_race`` returns it.
        onboard: the onboard model, of the motor-level vehicle.
        plant: of the plant.
        policy: a policy file's content.
        lap_count: laps to fly, from hover.
        runs: number of independent drones.
        recorded: runs whose frames are kept.
        deterministic: apply the mean action rather than samples.

    Raises:
        InputError: files of the plant that cannot be read.
    """
    choices, params = race
    params = exact_rules(choices.model, params)
    pilot = make_pilot(choices, params, policy, deterministic)
    hold = round(plant.sample_rate / plant.control_rate)
    own = FlightChoices(choices, OnboardChoices(plant.navigation, plant.disturbance), hold)
    charge = tuple(jnp.float32(x) for x in plant.battery.charge)
    numbers = FlightParams(build_plant(plant), params, _onboard(onboard, plant, params), charge)
    limit = round(laps.time_limit(params.track, lap_count) * plant.control_rate)
    step = 1.0 / plant.control_rate
    return Plan(own, numbers, pilot, step, limit, lap_count, runs, min(recorded, runs))


def _onboard(model: VehicleParams, plant: PlantConfig, race: RaceParams) -> OnboardParams:
    """Sensors, filters and inner loop."""
    rate, c = plant.sample_rate, model.constants
    first = c.rpm_max if race.battery is None else middle_limit(race.battery)
    return OnboardParams(
        sensors=sensor_params(plant.sensors, rate),
        ekf=ekf_params(plant.sensors, rate, float(model.constants.g)),
        estimator=estimator_params(motor.MODEL, model, rate),
        inner=indi_params(nominal_vehicle(plant).motor, plant.indi, rate),
        limit=limit_estimator(c.rpm_max, c.tau, rate),
        first_limit=first,
    )


def check_steps(layout: Layout, trained: float, step: float) -> None:
    """Check that a policy that observes earlier steps flies in steps of its training.

    Args:
        layout: of the policy.
        trained: time step of the training, s.
        step: of the control loop, s.

    Raises:
        InputError: a history or a last action, and another step.
    """
    if layout.counts_steps and abs(step / trained - 1.0) > SAME_STEP:
        raise InputError(
            f"the policy observes earlier steps of {trained:g} s, the drone's control steps are "
            f"{step:g} s: add control_rate={1.0 / trained:g}"
        )


def fly_chunks(
    plan: Plan, seed: int = 0, record: Recorder = flight.record_frame
) -> Iterator[tuple[Flight, Record]]:
    """Fly until every drone has finished or crashed, a second at a time.

    Args:
        plan: the flights.
        seed: of batteries, gusts, sensors and the policy's noise.
        record: what is kept of a control step.

    Yields:
        The drones, and the records of the chunk as NumPy arrays.

    Raises:
        InputError: see ``check_steps``.
    """
    race = plan.params.race
    check_steps(plan.choices.race.layout, float(race.rules.time_step), plan.step)
    start, key = jax.random.split(jax.random.key(seed))
    drones = jax.jit(flight.begin, static_argnums=(0, 3, 4))(
        plan.choices, plan.params, start, plan.runs, plan.laps
    )
    chunk = max(1, round(CHUNK_SECONDS / plan.step))
    for number in range(-(-plan.limit // chunk)):
        own = jax.random.fold_in(key, number)
        drones, frames = flight.fly_on(
            plan.choices, chunk, plan.params, plan.pilot, drones, own, plan.recorded, record
        )
        yield drones, jax.tree.map(np.asarray, frames)
        if bool(jnp.all(drones.race.over)):
            return


def fly_plan(
    plan: Plan, seed: int = 0, report: Callable[[float], None] = lambda seconds: None
) -> Flights:
    """Fly until every drone has finished or crashed.

    Args:
        plan: the flights.
        seed: of batteries, gusts, sensors and the policy's noise.
        report: called with the simulated seconds.
    """
    kept: list[Frame] = []
    for flying, frames in fly_chunks(plan, seed):
        drones = flying
        kept.append(frames)
        report(len(kept) * max(1, round(CHUNK_SECONDS / plan.step)) * plan.step)
    joined = jax.tree.map(lambda *parts: np.concatenate(parts), *kept)
    result = laps.laps_of(
        plan.choices.race, drones.race, float(plan.params.plant.step), plan.limit * plan.step
    )
    return Flights(result, joined, plan.step)


def rows(flights: Flights, vector: Vec3 | Rotors | RateCommand, run: int) -> np.ndarray:
    """Components (n, k) of a vector of the frames in one recorded run, until its end."""
    going = ~flights.frames.over[:, run]
    columns = [np.asarray(x)[going, run] for x in jax.tree.leaves(vector)]
    return np.stack(columns, axis=1).astype(np.float64)


def recorded_flights(
    flights: Flights, gates: Sequence[GateSection], model: VehicleModel
) -> list[recorded.Flight]:
    """The recorded runs by their true states, each cut at its end, numbered from 1.

    Args:
        flights: that have ended.
        gates: of the track, in order of passage.
        model: of the policy, whose commands and actuators they have.
    """
    frames, result = flights.frames, []
    for run in range(frames.over.shape[-1]):
        true, target = frames.true, np.asarray(frames.target)[~frames.over[:, run], run]
        values = {
            "position": rows(flights, true.position, run),
            "velocity": rows(flights, true.velocity, run),
            "attitude": rows(flights, true.euler, run),
            "rates": rows(flights, true.rates, run),
            "actuators": rows(flights, true.actuators, run),
            "command": rows(flights, frames.command, run),
            "target": target[:, None].astype(np.float64),
        }
        times, crash = flights.laps.lap_times[run], flights.laps.crashes[run]
        name = f"{run + 1}"
        result.append(
            recorded.simulated_flight(name, flights.step, values, gates, model, times, crash)
        )
    return result
