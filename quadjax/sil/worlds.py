"""The drones that exported C can fly: a plant, or the simulator of the race.

A world is pure functions of a state: its start, and a control step under a command that is held.
Both also give what the autopilot observes, and the true motion for the record.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core import quaternion
from quadjax.core.vectors import Rotors, Vec3
from quadjax.export.verify.build import VEHICLE
from quadjax.plant import flight, plant
from quadjax.plant.flight import Drones, Plan
from quadjax.policy.pilot import command_ranges
from quadjax.race import laps
from quadjax.race.environment import Race, without_training_limits
from quadjax.race.laps import Laps, LapState
from quadjax.race.memory import DISTURBANCE
from quadjax.race.types import RaceParams
from quadjax.sil.faults import RPM_PER_RAD_S
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.protocol import Measurement, VehicleModel

SET_BY_C = ("time_us", "rpm", "others_command")  # of ``VEHICLE``, in sil.c
MEASURED = [name for name in VEHICLE.names or () if name not in SET_BY_C]
Seen = tuple[jax.Array, jax.Array, jax.Array, jax.Array]  # what ``Now`` has after the state
Motion = tuple[Vec3, Vec3, Vec3, Vec3]  # position, velocity, Euler angles, rates


@dataclasses.dataclass(frozen=True)
class Now:
    """A drone between two control steps."""

    state: Any  # pytree of the world
    numbers: np.ndarray  # (n,) float32 of ``MEASURED``
    target: np.ndarray | int  # () int32
    true: np.ndarray  # (12 + actuators,): position, velocity, Euler angles, rates, actuators
    over: np.ndarray | bool  # ()

    @property
    def vehicle(self) -> np.ndarray:
        """What the autopilot observes, a ``VEHICLE`` ()."""
        vehicle, start = np.zeros((), VEHICLE), 0
        for name in MEASURED:
            size = vehicle[name].size
            vehicle[name] = self.numbers[start : start + size].reshape(vehicle[name].shape)
            start += size
        return vehicle


@dataclasses.dataclass(frozen=True)
class World:
    """A simulated drone in a race."""

    name: str  # for the result
    environment: Race
    params: RaceParams  # of the race
    step: float  # of the control loop, s
    limit: int  # control steps, after which a race is out of time
    begin: Callable[[int], Now]  # a race before its first step, of a seed
    # one control step later under a command (4,), in the model's units
    advance: Callable[[Now, np.ndarray], Now]
    result: Callable[[Now], Laps]  # the laps of the race so far

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


def _seen(
    target: jax.Array,
    over: jax.Array,
    motion: Motion,
    measured: Measurement,
    rotors: Rotors,
    thrust: jax.Array,
    disturbance: tuple[Vec3, Vec3],
    true: Any,
) -> Seen:
    """Numbers of a state from the estimated motion, and the true motion with the actuators."""
    position, velocity, euler, rates = motion
    parts = (
        *(position, velocity, euler, quaternion.of_euler(euler), rates, rotors, thrust),
        *(*disturbance, measured.gyro, measured.specific_force, measured.body_velocity),
    )
    numbers = jnp.stack([jnp.asarray(x, jnp.float32) for x in jax.tree.leaves(parts)])
    return numbers, target, jnp.stack(jax.tree.leaves(true)), over


def _scaled(rotors: Rotors, factor: float) -> Rotors:
    return jax.tree.map(lambda x: x * jnp.float32(factor), rotors)


# ---- plant ---------------------------------------------------------------------------------------


def plant_world(plan: Plan, name: str) -> World:
    """The plant of a plan, by its name, with its sensors and estimators.

    A race begins at hover at the last gate, with drawn battery, gusts and sensors.
    """

    def begin(seed: int) -> Now:
        start, key = jax.random.split(jax.random.key(seed))
        state, seen = _begin_on_plant(plan, start)
        return Now((state, key), *jax.device_get(seen))

    def advance(now: Now, command: np.ndarray) -> Now:
        state, key = now.state
        state, key, seen = _advance_plant(plan, state, command, key)
        return Now((state, key), *jax.device_get(seen))

    def result(now: Now) -> Laps:
        step, limit = float(plan.plant.step), plan.limit * plan.step
        return laps.laps_of(plan.environment, now.state[0].race, step, limit)

    numbers = (plan.environment, plan.race, plan.step, plan.limit)
    return World(f"plant {name}", *numbers, begin, advance, result)


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
    actuators = -force.z if rate_level else body.actuators
    return _seen(
        *(one.race.state.target, one.race.over),
        *((now.position, now.velocity, now.euler, now.rates), measured),
        _scaled(measured.actuators, 1.0 / RPM_PER_RAD_S),
        onboard.inner.thrust if rate_level else jnp.zeros(()),
        (now.moment_ext, now.force_ext),
        (body.position, body.velocity, body.euler, body.rates, actuators),
    )


# ---- simulator -----------------------------------------------------------------------------------


def simulator_world(environment: Race, params: RaceParams, lap_count: int) -> World:
    """The simulator of a race, by the exact rules of timed laps; the state is known exactly.

    A race begins at hover before the first gate, with drawn disturbances.
    """
    params = without_training_limits(environment.model, params)
    low, high = (np.float32(end) for end in command_ranges(environment, params))
    step = float(params.rules.time_step)

    def begin(seed: int) -> Now:
        key = jax.random.key(seed)
        state, seen = _begin_in_simulator(environment, lap_count, params, key)
        return Now(state, *jax.device_get(seen))

    def advance(now: Now, command: np.ndarray) -> Now:
        action = 2.0 * (command - low) / (high - low) - np.float32(1.0)
        state, seen = _advance_simulator(environment, params, now.state, action)
        return Now(state, *jax.device_get(seen))

    def result(now: Now) -> Laps:
        return laps.laps_of(environment, now.state, step, laps.time_limit(params.track, lap_count))

    limit = laps.step_limit(params, lap_count)
    return World("simulator", environment, params, step, limit, begin, advance, result)


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
    drone, zero = one.state.drone, jnp.zeros(())
    disturbance = drone.disturbance if model.disturbed else (Vec3.zero(), Vec3.zero())
    if (estimate := one.state.memories.get(DISTURBANCE)) is not None:
        disturbance = estimate.moment, estimate.force
    actuators, has_rotors = drone.actuators, model.actuators.size == 4
    unit = 1.0 / RPM_PER_RAD_S if model.actuators.unit == "rpm" else 1.0
    motion = (drone.position, drone.velocity, drone.euler, drone.rates)
    return _seen(
        *(one.state.target, one.over),
        *(motion, model.measure(params.vehicle, drone)),
        _scaled(actuators, unit) if has_rotors else Rotors.same(zero),
        zero if has_rotors else actuators,
        *(disturbance, (motion, actuators)),
    )
