"""The drones that software in the loop can fly: a plant, or the simulator of the race.

A drone is pure functions of a state: its start, and a control step under a command that is held.
Both also give what the autopilot observes, and the true motion for the record.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import quaternion
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors
from quadjax.export.library import VEHICLE
from quadjax.plant import flight, plant
from quadjax.plant.flight import Drones, Plan
from quadjax.policy.pilot import command_ranges
from quadjax.race import laps
from quadjax.race.environment import Race, without_training_limits
from quadjax.race.laps import Laps, LapState
from quadjax.race.types import RaceParams
from quadjax.vehicle.airframe import RPM_PER_RAD_S
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.protocol import State, VehicleModel

# A drone between two control steps, as arrays: "vehicle", by the fields of ``VEHICLE``; "true", the
# motion and the actuators; "target" and "over".
Seen = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class DroneState:
    """A drone between two control steps."""

    state: Any  # pytree of the drone
    vehicle: np.ndarray  # () of ``VEHICLE``: what the autopilot observes; without times
    true: Mapping[str, np.ndarray]  # position, velocity, attitude, rates, actuators
    target: int
    over: bool

    @classmethod
    def of(cls, state: Any, seen: Seen) -> "DroneState":
        """The state of a drone of what its program returned."""
        seen = jax.device_get(seen)
        vehicle = np.zeros((), VEHICLE)
        for name, value in seen["vehicle"].items():
            vehicle[name] = value
        return cls(state, vehicle, seen["true"], int(seen["target"]), bool(seen["over"]))


@dataclasses.dataclass(frozen=True)
class SimulatedDrone:
    """A simulated drone in a race."""

    name: str  # for the result
    environment: Race
    params: RaceParams  # of the race
    step: float  # of the control loop, s
    limit: int  # control steps, after which a race is out of time
    begin: Callable[[int], DroneState]  # a race before its first step, of a seed
    # one control step later under a command (4,), in the model's units
    advance: Callable[[DroneState, np.ndarray], DroneState]
    result: Callable[[DroneState], Laps]  # the laps of the race so far

    @property
    def model(self) -> VehicleModel:
        """Of the commands."""
        return self.environment.model

    def constants(self) -> dict[str, float]:
        """The constants by name."""
        return {k: float(x) for k, x in values_of(self.params.vehicle.constants).items()}

    def ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest command (4,), in the model's units."""
        return command_ranges(self.environment, self.params)


def _arrays(values: Mapping[str, Any]) -> dict[str, jax.Array]:
    """Vectors and scalars as arrays."""
    return {
        name: jnp.stack([jnp.asarray(x, jnp.float32) for x in leaves]) if len(leaves) > 1
        else jnp.asarray(leaves[0], jnp.float32)
        for name, leaves in ((name, jax.tree.leaves(value)) for name, value in values.items())
    }  # fmt: skip


# ---- plant ---------------------------------------------------------------------------------------


def plant_drone(plan: Plan, name: str) -> SimulatedDrone:
    """The plant of a plan, by its name, with its sensors and estimators.

    A race begins at hover at the last gate, with drawn battery, gusts and sensors.
    """

    def begin(seed: int) -> DroneState:
        start, key = jax.random.split(jax.random.key(seed))
        state, seen = _begin_on_plant(plan, start)
        return DroneState.of((state, key), seen)

    def advance(now: DroneState, command: np.ndarray) -> DroneState:
        state, key = now.state
        state, key, seen = _advance_plant(plan, state, command, key)
        return DroneState.of((state, key), seen)

    def result(now: DroneState) -> Laps:
        step, limit = float(plan.plant.step), plan.limit * plan.step
        return laps.laps_of(plan.environment, now.state[0].race, step, limit)

    numbers = (plan.environment, plan.race, plan.step, plan.limit)
    return SimulatedDrone(f"plant {name}", *numbers, begin, advance, result)


@jax.jit
def _begin_on_plant(plan: Plan, key: jax.Array) -> tuple[Drones, Seen]:
    drones = flight.begin(plan, key)
    return drones, _see_plant(plan, drones)


@jax.jit
def _advance_plant(
    plan: Plan, drones: Drones, command: jax.Array, key: jax.Array
) -> tuple[Drones, jax.Array, Seen]:
    key, key_of_step = jax.random.split(key)
    low, _ = plan.environment.model.command_range(plan.race.vehicle.constants)
    held = jax.tree.unflatten(jax.tree.structure(low), [x[None] for x in command])
    drones, _ = flight.hold_command(plan, drones, held, key_of_step)
    return drones, key, _see_plant(plan, drones)


def _see_plant(plan: Plan, drones: Drones) -> Seen:
    one = jax.tree.map(lambda x: x[..., 0], drones)
    onboard, body = one.onboard, one.plant.physics.body
    now, measured = onboard.estimate.motion, onboard.estimate.measurement
    rate_level = plan.environment.model.name == "rate"
    force = plant.truth_of(plan.plant, one.plant).specific_force
    vehicle = {
        "position": now.position,
        "velocity": now.velocity,
        "quaternion": quaternion.of_euler(now.euler),
        "rates": now.rates,
        "rotor_speed": measured.actuators.array() / RPM_PER_RAD_S,
        "thrust": onboard.inner.thrust if rate_level else -measured.specific_force.z,
        "specific_force": measured.specific_force,
        "body_velocity": measured.body_velocity,
    }
    actuators = (-force.z,) if rate_level else body.actuators
    return _seen(vehicle, body, actuators, one.race.state.target, one.race.over)


def _seen(
    vehicle: Mapping[str, Any], body: State, actuators: Any, target: jax.Array, over: jax.Array
) -> Seen:
    true = {"position": body.position, "velocity": body.velocity, "attitude": body.euler}
    true |= {"rates": body.rates, "actuators": actuators}
    return {"vehicle": _arrays(vehicle), "true": _arrays(true), "target": target, "over": over}


# ---- simulator -----------------------------------------------------------------------------------


def simulator_drone(environment: Race, params: RaceParams, lap_count: int) -> SimulatedDrone:
    """The simulator of a race, by the exact rules of timed laps; the state is known exactly.

    A race begins at hover before the first gate, with drawn disturbances.
    """
    params = without_training_limits(environment.model, params)
    low, high = (np.float32(end) for end in command_ranges(environment, params))
    step = float(params.rules.time_step)

    def begin(seed: int) -> DroneState:
        key = jax.random.key(seed)
        state, seen = _begin_in_simulator(environment, lap_count, params, key)
        return DroneState.of(state, seen)

    def advance(now: DroneState, command: np.ndarray) -> DroneState:
        action = 2.0 * (command - low) / (high - low) - np.float32(1.0)
        state, seen = _advance_simulator(environment, params, now.state, action)
        return DroneState.of(state, seen)

    def result(now: DroneState) -> Laps:
        return laps.laps_of(environment, now.state, step, laps.time_limit(params.track, lap_count))

    limit = laps.step_limit(params, lap_count)
    return SimulatedDrone("simulator", environment, params, step, limit, begin, advance, result)


@functools.partial(jax.jit, static_argnames=("environment", "lap_count"))
def _begin_in_simulator(
    environment: Race, lap_count: int, params: RaceParams, key: jax.Array
) -> tuple[LapState, Seen]:
    state = laps.starting_states(environment, params, key, 1, from_hover=True)
    race = laps.begin(state, lap_count)
    return race, _see_simulator(environment, params, race)


@functools.partial(jax.jit, static_argnames="environment")
def _advance_simulator(
    environment: Race, params: RaceParams, race: LapState, action: jax.Array
) -> tuple[LapState, Seen]:
    one = functools.partial(laps.advance, environment, params, action=action)
    race = jax.vmap(one, -1, -1)(race)
    return race, _see_simulator(environment, params, race)


def _see_simulator(environment: Race, params: RaceParams, race: LapState) -> Seen:
    one, model = jax.tree.map(lambda x: x[..., 0], race), environment.model
    drone, has_rotors = one.state.drone, environment.model.actuators.size == 4
    measured = model.measure(params.vehicle, drone)
    attitude = drone.attitude
    unit = RPM_PER_RAD_S if model.actuators.unit == "rpm" else 1.0
    zero = Rotors.same(jnp.zeros(()))
    vehicle = {
        "position": drone.position,
        "velocity": drone.velocity,
        "quaternion": attitude
        if isinstance(attitude, Quaternion)
        else quaternion.of_euler(attitude),
        "rates": drone.rates,
        "rotor_speed": (drone.actuators if has_rotors else zero).array() / unit,
        "thrust": -measured.specific_force.z if has_rotors else drone.actuators,
        "specific_force": measured.specific_force,
        "body_velocity": measured.body_velocity,
    }
    return _seen(vehicle, drone, drone.actuators, one.state.target, one.over)
