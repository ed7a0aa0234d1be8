"""Races on a plant: the policy observes the onboard estimate.

Rules, gates and laps are those of ``quadjax.race``, applied to the true motion at every sample.
"""

import functools

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Rotors
from quadjax.plant import gusts, onboard, plant, sensors
from quadjax.plant.onboard import OnboardParams, OnboardState, StateEstimate
from quadjax.plant.plant import PlantParams, PlantState
from quadjax.policy.pilot import Pilot, act
from quadjax.race import laps
from quadjax.race.environment import Race, advance_race
from quadjax.race.episode import hover
from quadjax.race.memory import advance_memories, begin_memories
from quadjax.race.rules import evaluate_rules
from quadjax.race.track import gate, gate_count
from quadjax.race.types import RaceParams, RaceState, Step
from quadjax.vehicle import motor
from quadjax.vehicle.battery import BatteryState
from quadjax.vehicle.rate import RateCommand
from quadjax.vehicle.rigid_body import RigidBodyState


class Plan(struct.PyTreeNode):
    """Flights before the start: every number; environment and sizes are static."""

    plant: PlantParams
    race: RaceParams
    onboard: OnboardParams
    pilot: Pilot
    charge: tuple[jax.Array, jax.Array]  # lowest and highest at the start
    environment: Race = struct.field(pytree_node=False)
    step: float = struct.field(pytree_node=False)  # s, of the control loop
    samples_per_command: int = struct.field(pytree_node=False)  # samples in a control step
    limit: int = struct.field(pytree_node=False)  # control steps until a flight is out of time
    laps: int = struct.field(pytree_node=False)
    runs: int = struct.field(pytree_node=False)  # independent drones
    recorded: int = struct.field(pytree_node=False)  # runs, the first ones, whose frames are kept
    # Which leaves of plant and onboard differ among the runs: (.., runs), with those of the drone
    # that each run flies.
    differ: tuple[bool, ...] = struct.field(pytree_node=False)


class Drones(struct.PyTreeNode):
    """Drones in flight, batched along the last axis."""

    race: laps.LapState
    plant: PlantState
    onboard: OnboardState


class Frame(struct.PyTreeNode):
    """Record of one control step."""

    true: RigidBodyState  # with the external moment and force that the policy observed
    estimate: StateEstimate
    command: Rotors | RateCommand  # of the policy
    rpm_command: Rotors  # rpm, in the last sample of the step
    thrust: jax.Array | None  # m/s^2, () of the inner loop, of a policy that commands it
    target: jax.Array  # () int32
    over: jax.Array  # () bool, before the step


def axes(plan: Plan) -> Plan:
    """The axis of each leaf of a plan along which it has one entry for each run; or None."""
    own = (plan.plant, plan.onboard)
    differ = [-1 if differs else None for differs in plan.differ]
    plant, onboard = jax.tree.unflatten(jax.tree.structure(own), differ)
    return plan.replace(plant=plant, onboard=onboard, race=None, pilot=None, charge=None)


@jax.jit
def begin(plan: Plan, key: jax.Array) -> Drones:
    """Drones in hover at the last gate, with drawn batteries, gusts and sensors."""

    def one(
        plan: Plan, draws: jax.Array, charge: jax.Array
    ) -> tuple[RaceState, PlantState, OnboardState]:
        body = hover(motor.MODEL, plan.plant.vehicle.constants, plan.race.track)
        low, high = plan.charge
        left = low + (high - low) * charge
        first, rest = draws[: gusts.START_DRAWS], draws[gusts.START_DRAWS :]
        state = plant.begin(plan.plant, body, left, first)
        computers = onboard.begin(plan.onboard, plan.plant, state, rest)
        zero = jnp.zeros((), jnp.int32)
        known = RaceState(_known_motion(plan, computers), zero, zero, zero, None)
        memories = begin_memories(plan.environment, plan.race, known).memories
        return RaceState(body, zero, zero, zero, None, memories), state, computers

    of_noise, of_charge = jax.random.split(key)
    count = gusts.START_DRAWS + sensors.START_DRAWS
    draws = jax.random.normal(of_noise, (count, plan.runs))
    charge = jax.random.uniform(of_charge, (plan.runs,))
    start = jax.vmap(one, in_axes=(axes(plan), -1, -1), out_axes=-1)
    race, state, computers = start(plan, draws, charge)
    return Drones(laps.begin(race, plan.laps), state, computers)


def sample(
    plan: Plan, drones: Drones, command: Rotors | RateCommand, draws: jax.Array
) -> tuple[Drones, Rotors]:
    """One sample of one drone: inner loop, plant, sensors, filters and rules.

    ``draws`` holds (onboard.DRAWS,) standard normal numbers. Returns the rpm commands too.
    """
    computers, rotors = onboard.command_rotors(plan.onboard, drones.onboard, command)
    first, rest = draws[: gusts.DRAWS], draws[gusts.DRAWS :]
    opaque_true = plan.plant.step > 0.0
    state = plant.update(plan.plant, drones.plant, rotors, first, opaque_true)
    computers = onboard.sense(plan.onboard, plan.plant, state, computers, rotors, rest)
    before, body = drones.race.state, state.physics.body
    g = gate(plan.race.track, before.target)
    step = Step(plan.environment.model, plan.race, before, g, body)
    outcome = evaluate_rules(step, plan.environment.user_rules)
    next_state = advance_race(plan.race, before, body, outcome)
    gates = gate_count(plan.race.track)
    race = laps.count_laps(drones.race, next_state, outcome, plan.plant.step, gates)
    return Drones(race, state, computers), rotors


def observe(plan: Plan, drones: Drones) -> jax.Array:
    """Observation (n,) of one drone's policy: the race with the estimated state."""
    motion = _known_motion(plan, drones.onboard)
    # The charge is not known on board.
    charged = BatteryState(jnp.zeros(()), drones.onboard.limit)
    state = drones.race.state.replace(drone=motion, battery=charged)
    return plan.environment.observation(plan.race, state)


def hold_command(
    plan: Plan, drones: Drones, command: Rotors | RateCommand, key: jax.Array
) -> tuple[Drones, Rotors]:
    """All drones one control step later, under commands of each that are held.

    ``key`` is that of the plant's and the sensors' noise.

    Returns:
        The drones, and the rpm commands of the step's last sample.
    """
    advance = jax.vmap(sample, (axes(plan), -1, -1, -1), -1)

    def one(drones: Drones, key: jax.Array) -> tuple[Drones, Rotors]:
        draws = jax.random.normal(key, (onboard.DRAWS, plan.runs))
        return advance(plan, drones, command, draws)

    after, rotors = jax.lax.scan(one, drones, jax.random.split(key, plan.samples_per_command))
    return after, jax.tree.map(lambda x: x[-1], rotors)


def _known_motion(plan: Plan, computers: OnboardState) -> RigidBodyState:
    """The estimated state, of the race's vehicle model."""
    motion = computers.estimate.motion
    if plan.environment.model.name != "rate":
        return motion
    thrust = computers.inner.thrust
    return RigidBodyState(motion.position, motion.velocity, motion.euler, motion.rates, thrust)


def remember(plan: Plan, before: Drones, drones: Drones, action: jax.Array) -> Drones:
    """One drone after a control step, with the memories of its policy."""
    race, state = plan.environment, drones.race.state
    known, after = (_known_motion(plan, x.onboard) for x in (before, drones))
    began = before.race.state.replace(drone=known)
    g = gate(plan.race.track, began.target)
    memories = advance_memories(race, Step(race.model, plan.race, began, g, after, action=action))
    return drones.replace(race=drones.race.replace(state=state.replace(memories=memories)))


@functools.partial(jax.jit, static_argnames="steps")
def advance(plan: Plan, steps: int, drones: Drones, key: jax.Array) -> tuple[Drones, Frame]:
    """Fly all drones for some control steps.

    ``key`` is that of the policy's, the plant's and the sensors' noise.

    Returns:
        The drones, and the frames of the recorded runs: time first, runs last.
    """
    act_all = jax.vmap(act, in_axes=(None, 0, 0))
    command_of = jax.vmap(plan.environment.command, in_axes=(None, 0), out_axes=-1)

    def control(drones: Drones, key: jax.Array) -> tuple[Drones, Frame]:
        of_policy, of_plant = jax.random.split(key)
        observed = jax.vmap(observe, in_axes=(None, -1))(plan, drones)
        action = act_all(plan.pilot, observed, jax.random.normal(of_policy, (plan.runs, 4)))
        command = command_of(plan.race, action)
        after, rotors = hold_command(plan, drones, command, of_plant)
        recorded = jax.tree.map(lambda x: x[..., : plan.recorded], (drones, command, rotors))
        frame = jax.vmap(record_frame, (axes(plan), -1, -1, -1), -1)(first_runs(plan), *recorded)
        recall = jax.vmap(remember, (axes(plan), -1, -1, 0), -1)
        return recall(plan, drones, after, action), frame

    return jax.lax.scan(control, drones, jax.random.split(key, steps))


def first_runs(plan: Plan) -> Plan:
    """The plan of the recorded runs."""
    own, structure = jax.tree.flatten((plan.plant, plan.onboard))
    cut = [
        leaf[..., : plan.recorded] if differs else leaf
        for leaf, differs in zip(own, plan.differ, strict=True)
    ]
    plant, onboard = jax.tree.unflatten(structure, cut)
    return plan.replace(plant=plant, onboard=onboard)


def record_frame(
    plan: Plan, drones: Drones, command: Rotors | RateCommand, rotors: Rotors
) -> Frame:
    """The ``Frame`` of a control step of one drone."""
    now = drones.onboard.estimate
    true = drones.plant.physics.body
    return Frame(
        true=true.replace(
            rates=plant.truth_of(plan.plant, drones.plant).rates,
            moment_ext=now.motion.moment_ext,
            force_ext=now.motion.force_ext,
        ),
        estimate=now,
        command=command,
        rpm_command=rotors,
        thrust=drones.onboard.inner.thrust if isinstance(command, RateCommand) else None,
        target=drones.race.state.target,
        over=drones.race.over,
    )
