"""Races on the stand-in plant: a policy file flown by what the drone believes.

The rules, the gates and the laps are those of ``quadjax.race``, judged by
what is true at every sample of the plant.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.materialize import staged_values
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import gusts, onboard, plant, sensors
from quadjax.plant.onboard import OnboardChoices, OnboardParams, OnboardState
from quadjax.plant.plant import PlantParams, PlantState
from quadjax.policy.pilot import Pilot, fly
from quadjax.race import environment, laps
from quadjax.race.environment import Choices, RaceParams, RaceState
from quadjax.race.start import hover
from quadjax.race.track import gate, gate_count
from quadjax.vehicle import motor, rate
from quadjax.vehicle.motor import MotorState
from quadjax.vehicle.rate import RateCommand, RateState


@dataclasses.dataclass(frozen=True)
class FlightChoices:
    """What chooses code."""

    race: Choices
    onboard: OnboardChoices
    hold: int  # samples in a control step
    recorded: int  # of the first runs, what is flown is kept


@struct.dataclass
class FlightParams:
    """Every number of flights on the plant."""

    plant: PlantParams
    race: RaceParams
    onboard: OnboardParams
    charge: tuple[jax.Array, jax.Array]  # of the battery at the start, lowest and highest


@struct.dataclass
class Flight:
    """Drones in a race, batched along the last axis."""

    race: laps.Race
    plant: PlantState
    onboard: OnboardState


@struct.dataclass
class Frame:
    """What is kept of a control step, batched over the recorded runs along the last axis."""

    true: MotorState  # with the external moment and force that the policy was told
    believed: MotorState
    gyro: Vec3  # rad/s, as measured
    accelerometer: Vec3  # m/s^2, as measured
    force_bias: Vec3  # m/s^2, as believed
    specific_force: Vec3  # m/s^2, true
    command: Rotors | RateCommand  # the policy's
    rpm_command: Rotors  # rpm, as it leaves for the motors in this step's last sample
    target: jax.Array  # () int32
    over: jax.Array  # () bool, before the step


def begin(
    choices: FlightChoices, params: FlightParams, key: jax.Array, runs: int, lap_count: int
) -> Flight:
    """Drones hovering at the last gate, their batteries, gusts and sensors drawn."""

    def one(drawn: jax.Array, charge: jax.Array) -> tuple[RaceState, PlantState, OnboardState]:
        body = hover(motor.MODEL, params.plant.vehicle.constants, params.race.track)
        low, high = params.charge
        left = low + (high - low) * charge
        first, rest = drawn[: gusts.START_DRAWS], drawn[gusts.START_DRAWS :]
        state = plant.begin(params.plant, body, left, first)
        carried = onboard.begin(choices.onboard, params.onboard, params.plant, state, rest)
        zero = jnp.zeros((), jnp.int32)
        return RaceState(body, zero, zero, zero, None), state, carried

    of_noise, of_charge = jax.random.split(key)
    count = gusts.START_DRAWS + sensors.START_DRAWS
    drawn = jax.random.normal(of_noise, (count, runs))
    charge = jax.random.uniform(of_charge, (runs,))
    race, state, carried = jax.vmap(one, in_axes=-1, out_axes=-1)(drawn, charge)
    return Flight(laps.begin(race, lap_count), state, carried)


def sample(
    choices: FlightChoices,
    params: FlightParams,
    flight: Flight,
    command: Rotors | RateCommand,
    drawn: jax.Array,
) -> tuple[Flight, Rotors]:
    """One sample of one drone: inner loop, plant, sensors, filters and rules.

    ``drawn`` holds (onboard.DRAWS,) standard normal numbers. Returns the rpm commands too.
    """
    always = params.plant.step > 0.0

    def keep(function: object, *arguments: object) -> object:
        return staged_values(function, always, *arguments)

    carried, rotors = onboard.command_rotors(params.onboard, flight.onboard, command)
    first, rest = drawn[: gusts.DRAWS], drawn[gusts.DRAWS :]
    state = plant.update(params.plant, flight.plant, rotors, first, keep)
    carried = onboard.sense(choices.onboard, params.onboard, params.plant, state, carried, rest)
    before, body = flight.race.state, state.physics.body
    g = gate(params.race.track, before.target)
    outcome = environment.evaluate_rules(choices.race, params.race, before, body, g)
    following = environment.progressed(params.race, before, body, outcome)
    gates = gate_count(params.race.track)
    race = laps.score(flight.race, following, outcome, params.plant.step, gates)
    return Flight(race, state, carried), rotors


def see(choices: FlightChoices, params: FlightParams, flight: Flight) -> jax.Array:
    """What the policy of one drone sees: the race, with the drone as it is believed to be."""
    motion: MotorState | RateState = flight.onboard.belief.motion
    if choices.race.model is rate.MODEL:
        thrust = flight.onboard.inner.thrust
        motion = RateState(motion.position, motion.velocity, motion.euler, motion.rates, thrust)
    believed = flight.race.state.replace(drone=motion)
    return environment.observe(choices.race, params.race, believed)


@functools.partial(jax.jit, static_argnames=("choices", "steps"))
def fly_on(
    choices: FlightChoices,
    steps: int,
    params: FlightParams,
    pilot: Pilot,
    flight: Flight,
    key: jax.Array,
) -> tuple[Flight, Frame]:
    """All drones some control steps further, and what was flown: time first, runs last."""
    runs = flight.race.over.shape[-1]
    observe = jax.vmap(functools.partial(see, choices), in_axes=(None, -1))
    act = jax.vmap(fly, in_axes=(None, 0, 0))
    instruct = jax.vmap(
        functools.partial(environment.command, choices.race), in_axes=(None, 0), out_axes=-1
    )
    advance = jax.vmap(functools.partial(sample, choices), (None, -1, -1, -1), -1)

    def control(flight: Flight, key: jax.Array) -> tuple[Flight, Frame]:
        of_policy, of_plant = jax.random.split(key)
        noise = jax.random.normal(of_policy, (runs, 4))
        action = act(pilot, observe(params, flight), noise)
        command = instruct(params.race, action)

        def one(flight: Flight, key: jax.Array) -> tuple[Flight, Rotors]:
            drawn = jax.random.normal(key, (onboard.DRAWS, runs))
            return advance(params, flight, command, drawn)

        following, rotors = jax.lax.scan(one, flight, jax.random.split(of_plant, choices.hold))
        last = jax.tree.map(lambda x: x[-1], rotors)
        return following, _frame(choices, params, flight, command, last)

    return jax.lax.scan(control, flight, jax.random.split(key, steps))


def _frame(
    choices: FlightChoices,
    params: FlightParams,
    flight: Flight,
    command: Rotors | RateCommand,
    rotors: Rotors,
) -> Frame:
    belief = flight.onboard.belief
    truth = jax.vmap(plant.truth_of, in_axes=(None, -1), out_axes=-1)(params.plant, flight.plant)
    body = flight.plant.physics.body.replace(
        rates=truth.rates,
        moment_ext=belief.motion.moment_ext,
        force_ext=belief.motion.force_ext,
    )
    frame = Frame(
        true=body,
        believed=belief.motion,
        gyro=belief.gyro,
        accelerometer=belief.accelerometer,
        force_bias=belief.force_bias,
        specific_force=truth.specific_force,
        command=command,
        rpm_command=rotors,
        target=flight.race.state.target,
        over=flight.race.over,
    )
    return jax.tree.map(lambda x: x[..., : choices.recorded], frame)
