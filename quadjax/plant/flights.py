"""Timed flights of a policy file on a plant, in the race that a config describes."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.assembly import make_race, make_vehicle
from quadjax.config.schema import Config, Vehicle
from quadjax.core.errors import InputError
from quadjax.core.precision import single_precision
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors, Vec3
from quadjax.flights import flight as recorded
from quadjax.plant.config import PlantConfig
from quadjax.plant.flight import Frame, Plan, advance, begin
from quadjax.plant.onboard import onboard_params
from quadjax.plant.plant import build_plant, nominal_vehicle
from quadjax.plant.population import shared_or_stacked
from quadjax.policy.file import Policy
from quadjax.policy.pilot import adapt_race, make_pilot
from quadjax.policy.race import own_race, race_of_policy, warn_of_other_race
from quadjax.race import laps
from quadjax.race.environment import without_training_limits
from quadjax.race.laps import Laps, time_limit
from quadjax.race.layout import LAST_ACTION, Layout
from quadjax.race.track import GateSection
from quadjax.vehicle.battery import middle_limit
from quadjax.vehicle.motor import MODEL as MOTOR
from quadjax.vehicle.motor import hover_rpm
from quadjax.vehicle.protocol import VehicleModel
from quadjax.vehicle.rate import RateCommand

CHUNK_SECONDS = 1.0  # of flight between checks for the end
SAME_STEP = 1e-6  # relative difference of time steps that count as equal
SAME_HOVER, SAME_ROLL = 1.25, 2.0  # largest factors between numbers of the same drone


@dataclasses.dataclass(frozen=True)
class PlantFlights:
    """Flights that have ended."""

    laps: Laps  # the timed result
    frames: Frame  # of the recorded runs: time first, runs last, NumPy arrays
    step: float  # s between frames


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
    drones: int = 1,
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
        drones: of the plant, each with as many of the runs: run ``i`` flies drone ``i % drones``.

    Raises:
        InputError: a policy that does not fit or is of another drone, or files that cannot be
            read.
    """
    assert runs % drones == 0, (runs, drones)
    environment, params = adapt_race(*make_race(race_config(config, policy)), policy, name)
    params = without_training_limits(environment.model, params)
    environment = dataclasses.replace(environment, user_terms=())  # there is no reward
    check_drone(plant, config.vehicle)
    model = make_vehicle(config.replace(vehicle=config.vehicle.with_model("motor")))
    first_limit = None if params.battery is None else middle_limit(params.battery)
    low, high = plant.battery.charge
    flown = [plant.member(number) for number in range(drones)]
    bodies = [build_plant(drone) for drone in flown]
    waiting = max(body.commands_waiting for body in bodies)
    (own, onboard), differ = shared_or_stacked(
        [
            (body.replace(commands_waiting=waiting), onboard_params(drone, model, first_limit))
            for body, drone in zip(bodies, flown, strict=True)
        ],
        runs,
    )
    return Plan(
        plant=own,
        race=params,
        onboard=onboard,
        pilot=make_pilot(policy, deterministic),
        charge=(jnp.float32(low), jnp.float32(high)),
        environment=environment,
        step=1.0 / plant.control_rate,
        samples_per_command=round(plant.sample_rate / plant.control_rate),
        limit=round(time_limit(params.track, lap_count) * plant.control_rate),
        laps=lap_count,
        runs=runs,
        recorded=min(recorded, runs),
        differ=differ,
    )


def race_config(config: Config, policy: Policy) -> Config:
    """The race of one policy: its vehicle model, without disturbances and randomization.

    The vehicle has the constants that the policy was trained with, where its file has them, so that
    its commands have their meaning. On the plant the disturbance is that of the plant, estimated on
    board; the race adds none.
    """
    vehicle = config.vehicle.with_model(policy.vehicle)
    training, battery = own_race(policy, config), config.battery
    if training is not None:
        vehicle, battery = vehicle.replace(constants=training.vehicle.constants), training.battery
    return config.replace(
        vehicle=vehicle.replace(mismatch={}),
        battery=battery,
        disturbance=type(config.disturbance)(),
        randomization=type(config.randomization)(),
        observation=config.observation.replace(disturbance="ground_truth", highest_rpm="estimated"),
    )


@single_precision
def plan_logs(
    config: Config | None, plant: PlantConfig, policy: Path | str, flights: int, laps: int
) -> Plan:
    """Flights of the mean action of a policy on the plant, with a record of each sample.

    Args:
        config: of the race; its vehicle, with its residual, is the onboard model. None: the
            policy's own. There is an ``InputWarning`` where they differ.
        plant: of the plant.
        policy: its file, the folder of its run, or the name of a shipped policy.
        flights: number of flights.
        laps: of each flight, from hover.

    Returns:
        The plan, which ``write_logs`` flies.

    Raises:
        InputError: a policy that does not fit or is of another drone, or a file that cannot be
            read.
    """
    plant, network = plant.replace(control_rate=plant.sample_rate), Policy.load(policy, config)
    config, _ = race_of_policy(network, policy, config)
    warn_of_other_race(network, config, policy)
    return plan_race(
        config, plant, network, str(policy), lap_count=laps, runs=flights, recorded=flights
    )


def check_drone(plant: PlantConfig, model: Vehicle) -> None:
    """Check that the plant is the drone of a race, whose model is the one on board.

    The propeller speed in hover may differ by the factor ``SAME_HOVER``, and the roll acceleration
    from one rotor at that speed by ``SAME_ROLL``: more than by a fit, damage or another payload.

    Args:
        plant: of the plant.
        model: the vehicle of the race.

    Raises:
        InputError: another drone.
    """
    vehicle = nominal_vehicle(plant)
    constants = MOTOR.make_constants(model.with_model("motor").constants)
    drones = (vehicle.motor, constants)
    hover = [float(hover_rpm(c)) for c in drones]  # rpm
    roll = [float(c.k_p / c.i_xx) * speed**2 for c, speed in zip(drones, hover, strict=True)]
    compared = (
        ("a propeller speed in hover", "rpm", hover, SAME_HOVER),
        ("a roll acceleration from one rotor in hover", "rad/s^2", roll, SAME_ROLL),
    )
    for quantity, unit, (plant_value, race_value), factor in compared:
        if not 1.0 / factor <= plant_value / race_value <= factor:
            raise InputError(
                f"plant {plant.name}: its drone, {vehicle.name}, has {quantity} of "
                f"{plant_value:.0f} {unit}, but the vehicle of the race, {model.name}, is another "
                f"drone, with {race_value:.0f} {unit}; allowed: the race of this drone, "
                "vehicle=FILE with that drone, or a plant config with base: plant/standin and "
                "vehicle: FILE"
            )


def check_steps(layout: Layout, training_step: float, step: float) -> None:
    """Check that a policy that observes its last action flies in steps of its training.

    Args:
        layout: of the policy.
        training_step: time step of the training, s.
        step: of the control loop, s.

    Raises:
        InputError: an observed last action, and another step.
    """
    if LAST_ACTION in layout and abs(step / training_step - 1.0) > SAME_STEP:
        raise InputError(
            f"the policy observes the action of the step before, of {training_step:g} s, the "
            f"drone's control steps are {step:g} s: add control_rate={1.0 / training_step:g}"
        )


def fly_plan(
    plan: Plan, seed: int = 0, report: Callable[[float], None] = lambda seconds: None
) -> PlantFlights:
    """Fly until every drone has finished or crashed.

    Args:
        plan: the flights.
        seed: of batteries, gusts, sensors and the policy's noise.
        report: called with the simulated seconds.

    Raises:
        InputError: see ``check_steps``.
    """
    check_steps(plan.environment.layout, float(plan.race.rules.time_step), plan.step)
    start, key = jax.random.split(jax.random.key(seed))
    drones, frames = begin(plan, start), []
    chunk = max(1, round(CHUNK_SECONDS / plan.step))
    for number in range(-(-plan.limit // chunk)):
        drones, frame = advance(plan, chunk, drones, jax.random.fold_in(key, number))
        frames.append(jax.tree.map(np.asarray, frame))
        report(len(frames) * chunk * plan.step)
        if bool(jnp.all(drones.race.over)):
            break
    joined = jax.tree.map(lambda *parts: np.concatenate(parts), *frames)
    step, limit = float(plan.plant.step), plan.limit * plan.step
    return PlantFlights(laps.laps_of(plan.environment, drones.race, step, limit), joined, plan.step)


Vector = Vec3 | Quaternion | Rotors | RateCommand | tuple[jax.Array, ...]


def extract_rows(flights: PlantFlights, vector: Vector, run: int) -> np.ndarray:
    """Components (n, k) of a vector of the frames in one recorded run, until its end."""
    going = ~flights.frames.over[:, run]
    columns = [np.asarray(x)[going, run] for x in jax.tree.leaves(vector)]
    return np.stack(columns, axis=1).astype(np.float64)


def recorded_flights(
    flights: PlantFlights, gates: Sequence[GateSection], model: VehicleModel
) -> list[recorded.Flight]:
    """The recorded runs by their true states, each cut at its end, numbered from 1.

    The actuator of a policy that commands the inner loop is the thrust that this loop estimates.

    Args:
        flights: that have ended.
        gates: of the track, in order of passage.
        model: of the policy, whose commands and actuators they have.
    """
    frames, result, true = flights.frames, [], flights.frames.true
    actuators = true.actuators if frames.thrust is None else (frames.thrust,)
    motion = true.position, true.velocity, true.euler, true.rates, actuators
    for run in range(frames.over.shape[-1]):
        vectors = (*motion, frames.command, (frames.target,))
        columns = (extract_rows(flights, vector, run) for vector in vectors)
        values = dict(zip((*recorded.SIMULATED, "target"), columns, strict=True))
        ended = flights.laps.lap_times[run], flights.laps.crashes[run]
        name = f"{run + 1}"
        result.append(recorded.simulated_flight(name, flights.step, values, gates, model, *ended))
    return result


def log_quantities(flights: PlantFlights, run: int, gates: np.ndarray) -> dict[str, np.ndarray]:
    """One recorded run as quantities of a flight log, each (n,) or (n, k).

    Args:
        flights: that have ended.
        run: index of the recorded run.
        gates: (gates, 3) centers, m, world.
    """
    frames, now = flights.frames, flights.frames.estimate
    target = gates[np.asarray(frames.target)[~frames.over[:, run], run]]
    vectors = {
        "position": now.motion.position,
        "world_velocity": now.motion.velocity,
        "euler": now.motion.euler,
        "gyro": now.gyro,
        "rpm": now.motion.actuators,
        "rpm_command": frames.rpm_command,
        "acceleration": now.accelerometer,
        "acceleration_bias": now.force_bias,
    }
    if isinstance(frames.command, RateCommand):
        vectors["rate_command"] = frames.command.rates
        vectors["thrust_command"] = frames.command.thrust
    time = {"time": flights.step * np.arange(len(target)), "mode": np.ones(len(target))}
    columns = {name: extract_rows(flights, vector, run) for name, vector in vectors.items()}
    return time | columns | {"target_gate": target}
