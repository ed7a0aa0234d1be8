"""Flights of a policy in the race simulator, as the truth that sensors are to measure."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.config.schema import Config
from quadjax.core.vectors import Rotors
from quadjax.plant.truth import Truth
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot, command_ranges, fly, make_pilot, race_of
from quadjax.race import environment
from quadjax.race.environment import Choices, RaceParams, RaceState, exact_rules
from quadjax.race.laps import starting_states

WIDER = 0.25  # m by which each side of a gate is wider here: it is the filter that is judged


@dataclasses.dataclass(frozen=True)
class Setting:
    """What is flown and how.

    Attributes:
        sample_rate: of the physics, Hz; rounded to a multiple of the policy's rate.
        flights: how many drones.
        seconds: of each flight, as far as it gets.
        from_hover: start as a race does, else from the training's random starts.
        seed: of starts and of the policy's noise.
    """

    sample_rate: float = 500.0
    flights: int = 1000
    seconds: float = 20.0
    from_hover: bool = True
    seed: int = 0


@struct.dataclass
class Flight:
    """One drone under way."""

    race: RaceState
    over: jax.Array  # () bool, crashed: what follows is no flight


@struct.dataclass
class Seen:
    """One drone at one sample."""

    truth: Truth
    over: jax.Array  # () bool


@dataclasses.dataclass(frozen=True)
class Plan:
    """Flights ready to be flown."""

    choices: Choices
    params: RaceParams
    pilot: Pilot
    hold: int  # samples in a control step
    control_steps: int  # in all

    @property
    def sample_rate(self) -> float:
        """Hz."""
        return 1.0 / float(self.params.limits.dt)


def plan_flights(config: Config, policy: Policy, setting: Setting, name: str) -> Plan:
    """The flights of a policy: physics by Runge-Kutta steps between two of its commands.

    In these physics a policy that grazes the gates' edges in its own would touch them sooner or
    later, so the gates are wider.

    Args:
        config: of the race; its time step is the policy's.
        policy: a policy file's content.
        setting: what is flown and how.
        name: the policy's file, for messages.

    Raises:
        InputError: the policy does not fit the vehicle.
    """
    hold = max(1, round(config.episode.dt * setting.sample_rate))
    fine = dataclasses.replace(
        config,
        episode=dataclasses.replace(config.episode, dt=config.episode.dt / hold),
        vehicle=dataclasses.replace(config.vehicle, integrator="rk4"),
    )
    choices, params = race_of(fine, policy)
    choices = dataclasses.replace(choices, stagger_clocks=False)
    pilot = make_pilot(fine, policy, command_ranges(choices, params), False, name)
    steps = max(1, round(setting.seconds / config.episode.dt))
    params = exact_rules(choices.model, params)
    wide = params.replace(limits=params.limits.replace(gate_margin=jnp.float32(-WIDER)))
    return Plan(choices, wide, pilot, hold, steps)


def begin(plan: Plan, setting: Setting) -> tuple[Flight, Truth]:
    """All flights at their start, and their truth, batched along the last axis."""
    key = jax.random.key(setting.seed)
    states = starting_states(plan.choices, plan.params, key, setting.flights, setting.from_hover)
    look = jax.vmap(functools.partial(truth_of, plan.choices), (None, -1), -1)
    return Flight(states, jnp.zeros(setting.flights, bool)), look(plan.params, states)


def truth_of(choices: Choices, params: RaceParams, state: RaceState) -> Truth:
    """What is true of a racing drone; one that is flown by rates has no propeller speeds."""
    drone = state.drone
    vehicle = params.vehicle
    if state.constants is not None:
        vehicle = vehicle.replace(constants=state.constants)
    force = choices.model.specific_force(vehicle, drone)
    rpm = choices.model.actuator_state(drone)
    if not isinstance(rpm, Rotors):
        rpm = Rotors.same(jnp.zeros(()))
    return Truth(drone.position, drone.velocity, drone.euler, drone.rates, force, rpm)


def fly_on(plan: Plan, flights: Flight, key: jax.Array, steps: int) -> tuple[Flight, Seen]:
    """All flights some control steps further; the policy sees the truth.

    Args:
        plan: what is flown.
        flights: batched along the last axis.
        key: of the policy's noise.
        steps: control steps.

    Returns:
        The flights then, and what was true at every sample on the way, samples first.
    """
    return _fly_on(plan.choices, plan.hold, steps, plan.params, plan.pilot, flights, key)


@functools.partial(jax.jit, static_argnames=("choices", "hold", "steps"))
def _fly_on(
    choices: Choices,
    hold: int,
    steps: int,
    params: RaceParams,
    pilot: Pilot,
    flights: Flight,
    key: jax.Array,
) -> tuple[Flight, Seen]:
    count = flights.over.shape[-1]
    observe = jax.vmap(functools.partial(environment.observe, choices), in_axes=(None, -1))
    act = jax.vmap(fly, in_axes=(None, 0, 0))
    sample = jax.vmap(functools.partial(_sample, choices), (None, -1, 0), -1)

    def control(flights: Flight, key: jax.Array) -> tuple[Flight, Seen]:
        noise = jax.random.normal(key, (count, 4))
        action = act(pilot, observe(params, flights.race), noise)
        return jax.lax.scan(lambda f, _: sample(params, f, action), flights, None, hold)

    flights, seen = jax.lax.scan(control, flights, jax.random.split(key, steps))
    return flights, jax.tree.map(lambda x: x.reshape(-1, count), seen)


def _sample(
    choices: Choices, params: RaceParams, flight: Flight, action: jax.Array
) -> tuple[Flight, Seen]:
    """One sample of one drone; one that has crashed stands still."""
    following, _, outcome = environment.transition(choices, params, flight.race, action)
    over = flight.over | outcome.terminated
    race = jax.tree.map(lambda new, old: jnp.where(over, old, new), following, flight.race)
    return Flight(race, over), Seen(truth_of(choices, params, race), over)
