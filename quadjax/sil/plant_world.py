"""The stand-in plant as a drone that an autopilot flies."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.plant import flight, plant
from quadjax.plant.flight import Drones, Plan
from quadjax.policy.pilot import command_ranges
from quadjax.race import laps
from quadjax.race.laps import Laps
from quadjax.sil.message import RPM_PER_RAD_S
from quadjax.sil.worlds import Now, Seen, numbers, scaled
from quadjax.vehicle.protocol import VehicleModel


@dataclasses.dataclass(frozen=True)
class PlantWorld:
    """The stand-in plant with its sensors and estimators."""

    plan: Plan
    name: str = "stand-in plant"

    @property
    def model(self) -> VehicleModel:
        """Of the commands."""
        return self.plan.choices.model

    @property
    def step(self) -> float:
        """Of the control loop, s."""
        return self.plan.step

    @property
    def limit(self) -> int:
        """Control steps."""
        return self.plan.limit

    def ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest command."""
        return command_ranges(self.plan.choices, self.plan.race)

    def begin(self, seed: int) -> Now:
        """Hover at the last gate, with drawn battery, gusts and sensors."""
        start, key = jax.random.split(jax.random.key(seed))
        state, seen = _begin_on_plant(self.plan, start)
        return Now.of((state, key), seen)

    def advance(self, now: Now, command: np.ndarray) -> Now:
        """One control step."""
        state, key = now.state
        state, key, seen = _advance_plant(self.plan, state, command, key)
        return Now.of((state, key), seen)

    def result(self, now: Now) -> Laps:
        """By the rules of the race, at every sample."""
        plan = self.plan
        step = float(plan.plant.step)
        return laps.laps_of(plan.choices, now.state[0].race, step, plan.limit * plan.step)


@jax.jit
def _begin_on_plant(plan: Plan, key: jax.Array) -> tuple[Drones, Seen]:
    drones = flight.begin(plan, key)
    return drones, _see_plant(plan, drones)


@jax.jit
def _advance_plant(
    plan: Plan, drones: Drones, command: jax.Array, key: jax.Array
) -> tuple[Drones, jax.Array, Seen]:
    key, own = jax.random.split(key)
    low, _ = plan.choices.model.command_range(plan.race.vehicle.constants)
    held = jax.tree.unflatten(jax.tree.structure(low), [x[None] for x in command])
    drones, _ = flight.hold(plan, drones, held, own)
    return drones, key, _see_plant(plan, drones)


def _see_plant(plan: Plan, drones: Drones) -> Seen:
    one = jax.tree.map(lambda x: x[..., 0], drones)
    own, body, target = one.onboard, one.plant.physics.body, one.race.state.target
    now, measured = own.estimate.motion, own.estimate.measurement
    rate_level = plan.choices.model.name == "rate"
    thrust = own.inner.thrust if rate_level else jnp.zeros(())
    shown = numbers(
        *(now.position, now.velocity, measured.body_velocity, now.euler, now.rates),
        *(
            scaled(measured.rpm, 1.0 / RPM_PER_RAD_S),
            thrust,
            measured.gyro,
            measured.specific_force,
        ),
        *(now.moment_ext, now.force_ext, plan.race.track, target),
    )
    force = plant.truth_of(plan.plant, one.plant).specific_force
    actuators = [-force.z] if rate_level else jax.tree.leaves(body.actuators)
    motion = (body.position, body.velocity, body.euler, body.rates)
    true = jnp.stack([*jax.tree.leaves(motion), *actuators])
    return Seen(shown, target, true, one.race.over)
