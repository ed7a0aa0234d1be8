"""Races on the stand-in plant: the policy observes the onboard estimate.

Rules, gates and laps are those of ``quadjax.race``, applied to the true motion at every sample.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.materialize import call_materialized_forward
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import gusts, onboard, plant, sensors
from quadjax.plant.onboard import OnboardChoices, OnboardParams, OnboardState
from quadjax.plant.plant import PlantParams, PlantState
from quadjax.policy.pilot import Pilot, fly
from quadjax.race import environment, laps
from quadjax.race.environment import Choices, RaceParams, RaceState
from quadjax.race.episode import hover, no_action
from quadjax.race.layout import begin_past, push_past
from quadjax.race.rules import evaluate_rules
from quadjax.race.step import Step
from quadjax.race.track import gate, gate_count
from quadjax.vehicle import motor
from quadjax.vehicle.battery import BatteryState
from quadjax.vehicle.rate import RateCommand
from quadjax.vehicle.rigid_body import RigidBodyState


@dataclasses.dataclass(frozen=True)
class FlightChoices:
    """Static choices of code."""

    race: Choices
    onboard: OnboardChoices
    hold: int  # samples in a control step


@struct.dataclass
class FlightParams:
    """Numbers of flights on the plant."""

    plant: PlantParams
    race: RaceParams
    onboard: OnboardParams
    charge: tuple[jax.Array, jax.Array]  # lowest and highest at the start


@struct.dataclass
class Flight:
    """Drones in a race, batched along the last axis."""

    race: laps.LapState
    plant: PlantState
    onboard: OnboardState


@struct.dataclass
class Frame:
    """Record of one control step."""

    true: RigidBodyState  # with the external moment and force that the policy observed
    estimated: RigidBodyState
    gyro: Vec3  # rad/s, as measured
    accelerometer: Vec3  # m/s^2, as measured
    force_bias: Vec3  # m/s^2, estimated
    specific_force: Vec3  # m/s^2, true
    command: Rotors | RateCommand  # of the policy
    rpm_command: Rotors  # rpm, in the last sample of the step
    target: jax.Array  # () int32
    over: jax.Array  # () bool, before the step


# (params, flight before the step, command, rpm command of its last sample) -> record, of one drone
Record = Any  # a pytree of arrays, such as Frame
Recorder = Callable[[FlightParams, Flight, Rotors | RateCommand, Rotors], Record]


def begin(
    choices: FlightChoices, params: FlightParams, key: jax.Array, runs: int, lap_count: int
) -> Flight:
    """Drones in hover at the last gate, with drawn batteries, gusts and sensors."""

    def one(drawn: jax.Array, charge: jax.Array) -> tuple[RaceState, PlantState, OnboardState]:
        body = hover(motor.MODEL, params.plant.vehicle.constants, params.race.track)
        low, high = params.charge
        left = low + (high - low) * charge
        first, rest = drawn[: gusts.START_DRAWS], drawn[gusts.START_DRAWS :]
        state = plant.begin(params.plant, body, left, first)
        computers = onboard.begin(choices.onboard, params.onboard, params.plant, state, rest)
        zero, action = jnp.zeros((), jnp.int32), no_action(choices.race, params.race)
        known = _known_motion(choices, computers)
        race = RaceState(body, zero, zero, zero, None, action=action)
        past = begin_past(choices.race.layout, race.replace(drone=known))
        return race.replace(past=past), state, computers

    of_noise, of_charge = jax.random.split(key)
    count = gusts.START_DRAWS + sensors.START_DRAWS
    drawn = jax.random.normal(of_noise, (count, runs))
    charge = jax.random.uniform(of_charge, (runs,))
    race, state, computers = jax.vmap(one, in_axes=-1, out_axes=-1)(drawn, charge)
    return Flight(laps.begin(race, lap_count), state, computers)


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
    opaque_true = params.plant.step > 0.0

    def call(function: object, *arguments: object) -> object:
        return call_materialized_forward(function, opaque_true, *arguments)

    computers, rotors = onboard.command_rotors(params.onboard, flight.onboard, command)
    first, rest = drawn[: gusts.DRAWS], drawn[gusts.DRAWS :]
    state = plant.update(params.plant, flight.plant, rotors, first, call)
    computers = onboard.sense(
        choices.onboard, params.onboard, params.plant, state, computers, rotors, rest
    )
    before, body = flight.race.state, state.physics.body
    g = gate(params.race.track, before.target)
    step = Step(choices.race.model, params.race, before, g, body)
    outcome = evaluate_rules(step, choices.race.user_rules)
    following = environment.progressed(params.race, before, body, outcome)
    gates = gate_count(params.race.track)
    race = laps.score(flight.race, following, outcome, params.plant.step, gates)
    return Flight(race, state, computers), rotors


def observe(choices: FlightChoices, params: FlightParams, flight: Flight) -> jax.Array:
    """Observation (n,) of one drone's policy: the race with the estimated state."""
    motion = _known_motion(choices, flight.onboard)
    # The charge is not known on board.
    charged = BatteryState(jnp.zeros(()), flight.onboard.limit)
    state = flight.race.state.replace(drone=motion, battery=charged)
    return environment.observe(choices.race, params.race, state)


def hold(
    choices: FlightChoices,
    params: FlightParams,
    flight: Flight,
    command: Rotors | RateCommand,
    key: jax.Array,
) -> tuple[Flight, Rotors]:
    """All drones one control step later, under commands that are held.

    Args:
        choices: static choices.
        params: of the flights.
        flight: from ``begin`` or the last step.
        command: of each drone, along the last axis.
        key: of the plant's and the sensors' noise.

    Returns:
        The flights, and the rpm commands of the step's last sample.
    """
    runs = flight.race.over.shape[-1]
    advance = jax.vmap(functools.partial(sample, choices), (None, -1, -1, -1), -1)

    def one(flight: Flight, key: jax.Array) -> tuple[Flight, Rotors]:
        drawn = jax.random.normal(key, (onboard.DRAWS, runs))
        return advance(params, flight, command, drawn)

    following, rotors = jax.lax.scan(one, flight, jax.random.split(key, choices.hold))
    return following, jax.tree.map(lambda x: x[-1], rotors)


def _known_motion(choices: FlightChoices, computers: OnboardState) -> RigidBodyState:
    """The estimated state, of the race's vehicle model."""
    motion = computers.estimate.motion
    if choices.race.model.name != "rate":
        return motion
    thrust = computers.inner.thrust
    return RigidBodyState(motion.position, motion.velocity, motion.euler, motion.rates, thrust)


def remember(choices: FlightChoices, before: Flight, flight: Flight, action: jax.Array) -> Flight:
    """One drone's flight after a control step, with what the policy observes of the step itself."""
    state = before.race.state
    known = state.replace(drone=_known_motion(choices, before.onboard))
    past = push_past(state.past, known)
    given = None if state.action is None else environment.applied(choices.race, action)
    after = flight.race.state.replace(past=past, action=given)
    return flight.replace(race=flight.race.replace(state=after))


@functools.partial(jax.jit, static_argnames=("choices", "steps", "recorded", "record"))
def fly_on(
    choices: FlightChoices,
    steps: int,
    params: FlightParams,
    pilot: Pilot,
    flight: Flight,
    key: jax.Array,
    recorded: int,
    record: Recorder,
) -> tuple[Flight, Record]:
    """Advance all drones by some control steps.

    Args:
        choices: static choices.
        steps: control steps.
        params: of the flights.
        pilot: the policy.
        flight: from ``begin`` or the last call.
        key: of the policy's, the plant's and the sensors' noise.
        recorded: runs of which a record is kept: the first ones.
        record: what is kept of a step.

    Returns:
        The flights, and the records: time first, runs last.
    """
    runs = flight.race.over.shape[-1]
    see = jax.vmap(functools.partial(observe, choices), in_axes=(None, -1))
    act = jax.vmap(fly, in_axes=(None, 0, 0))
    instruct = jax.vmap(
        functools.partial(environment.command, choices.race), in_axes=(None, 0), out_axes=-1
    )
    note = jax.vmap(record, (None, -1, -1, -1), -1)
    keep = jax.vmap(functools.partial(remember, choices), (-1, -1, 0), -1)

    def control(flight: Flight, key: jax.Array) -> tuple[Flight, Record]:
        of_policy, of_plant = jax.random.split(key)
        noise = jax.random.normal(of_policy, (runs, 4))
        action = act(pilot, see(params, flight), noise)
        command = instruct(params.race, action)
        following, last = hold(choices, params, flight, command, of_plant)
        first = jax.tree.map(lambda x: x[..., :recorded], (flight, command, last))
        return keep(flight, following, action), note(params, *first)

    return jax.lax.scan(control, flight, jax.random.split(key, steps))


def record_frame(
    params: FlightParams, flight: Flight, command: Rotors | RateCommand, rotors: Rotors
) -> Frame:
    """The ``Frame`` of a control step of one drone."""
    now = flight.onboard.estimate
    truth = plant.truth_of(params.plant, flight.plant)
    return Frame(
        true=flight.plant.physics.body.replace(
            rates=truth.rates,
            moment_ext=now.motion.moment_ext,
            force_ext=now.motion.force_ext,
        ),
        estimated=now.motion,
        gyro=now.gyro,
        accelerometer=now.accelerometer,
        force_bias=now.force_bias,
        specific_force=truth.specific_force,
        command=command,
        rpm_command=rotors,
        target=flight.race.state.target,
        over=flight.race.over,
    )
