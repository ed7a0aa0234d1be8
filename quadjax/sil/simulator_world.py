"""The simulator of a race as a drone that an autopilot flies; the state is known exactly."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.vectors import Rotors, Vec3
from quadjax.policy.pilot import command_ranges
from quadjax.race import environment, laps
from quadjax.race.environment import Choices, RaceParams
from quadjax.race.laps import Laps, LapState
from quadjax.sil.message import RPM_PER_RAD_S
from quadjax.sil.worlds import Now, Seen, numbers, scaled
from quadjax.vehicle.protocol import VehicleModel


@dataclasses.dataclass(frozen=True)
class SimulatorWorld:
    """The simulator of the race in which a policy was trained; the state is known exactly."""

    choices: Choices
    params: RaceParams
    laps: int
    name: str = "simulator"

    @property
    def model(self) -> VehicleModel:
        """Of the commands."""
        return self.choices.model

    @property
    def step(self) -> float:
        """Of the simulation, s."""
        return float(self.params.rules.time_step)

    @property
    def limit(self) -> int:
        """Control steps."""
        return laps.step_limit(self.params, self.laps)

    def ranges(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest command."""
        return command_ranges(self.choices, self.params)

    def begin(self, seed: int) -> Now:
        """Hover before the first gate, with drawn disturbances."""
        key = jax.random.key(seed)
        return Now.of(*_begin_in_simulator(self.choices, self.laps, self.params, key))

    def advance(self, now: Now, command: np.ndarray) -> Now:
        """One step of the simulation."""
        low, high = (np.float32(end) for end in self.ranges())
        action = 2.0 * (command - low) / (high - low) - np.float32(1.0)
        return Now.of(*_advance_simulator(self.choices, self.params, now.state, action))

    def result(self, now: Now) -> Laps:
        """By the rules of the race."""
        limit = laps.time_limit(self.params.track, self.laps)
        return laps.laps_of(self.choices, now.state, self.step, limit)


def simulator_world(choices: Choices, params: RaceParams, lap_count: int) -> SimulatorWorld:
    """The simulator of a race, by the exact rules of timed laps."""
    exact = environment.exact_rules(choices.model, params)
    return SimulatorWorld(choices, exact, lap_count)


@functools.partial(jax.jit, static_argnames=("choices", "lap_count"))
def _begin_in_simulator(
    choices: Choices, lap_count: int, params: RaceParams, key: jax.Array
) -> tuple[LapState, Seen]:
    state = laps.starting_states(choices, params, key, 1, from_hover=True)
    race = laps.begin(state, lap_count)
    return race, _see_simulator(choices, params, race)


@functools.partial(jax.jit, static_argnames="choices")
def _advance_simulator(
    choices: Choices, params: RaceParams, race: LapState, action: jax.Array
) -> tuple[LapState, Seen]:
    one = functools.partial(laps.advance, choices, params, action=action)
    race = jax.vmap(one, -1, -1)(race)
    return race, _see_simulator(choices, params, race)


def _see_simulator(choices: Choices, params: RaceParams, race: LapState) -> Seen:
    one, model = jax.tree.map(lambda x: x[..., 0], race), choices.model
    drone, zero = one.state.drone, Vec3.zero()
    measured = model.measure(params.vehicle, drone)
    if one.state.estimate is not None:
        moment, force = one.state.estimate.moment, one.state.estimate.force
    else:
        moment, force = drone.disturbance if model.disturbed else (zero, zero)
    actuators = drone.actuators
    still = Rotors.same(jnp.zeros(()))
    unit = 1.0 / RPM_PER_RAD_S if model.actuators.unit == "rpm" else 1.0
    rotors = scaled(actuators, unit) if model.actuators.size == 4 else still
    thrust = actuators if model.actuators.size == 1 else jnp.zeros(())
    motion = (drone.position, drone.velocity, drone.angles, drone.rates)
    shown = numbers(
        *(motion[0], motion[1], measured.body_velocity, motion[2], motion[3], rotors, thrust),
        *(measured.gyro, measured.specific_force, moment, force),
        *(params.track, one.state.target),
    )
    true = jnp.stack(jax.tree.leaves((motion, actuators)))
    return Seen(shown, one.state.target, true, one.over)
