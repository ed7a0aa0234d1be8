"""The racing environment: vehicle, track, rules and starts as three pure functions of one drone.

``Choices`` are static (they choose code); ``RaceParams`` are traced (they are numbers).
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping, Sequence

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.environment import Environment
from quadjax.core.errors import InputError
from quadjax.core.gradients import clip_inward
from quadjax.core.integrators import INTEGRATORS
from quadjax.core.materialize import (
    call_materialized,
    materialize,
    materialize_cotangent,
)
from quadjax.core.traced import with_leaves
from quadjax.core.vectors import Vec3
from quadjax.race import starts
from quadjax.race.layout import LAST_ACTION, Layout, split_name
from quadjax.race.observations import Past, begin_past, make_layout, push_past
from quadjax.race.recorded_starts import RecordedStarts, draw_recorded
from quadjax.race.rewards import REWARDS, Reward, Term, reward, user_term
from quadjax.race.rules import (
    NOT_FINITE,
    TERMINATIONS,
    Outcome,
    Rules,
    TrainingLimits,
    judge,
    user_rule,
)
from quadjax.race.starts import Disturbance, Draws, Start
from quadjax.race.step import Step
from quadjax.race.track import Gate, Track, gate, gate_count
from quadjax.vehicle import estimator as onboard
from quadjax.vehicle import motor
from quadjax.vehicle.battery import (
    Battery,
    BatteryState,
    advance_battery,
    battery_at_start,
    draw_battery,
    limit_command,
)
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.protocol import Command, Constants, State, VehicleModel, VehicleParams

UserFunctions = tuple[
    tuple[str, Callable[[Step], jax.Array]], ...
]  # a user's functions, with their names


@dataclasses.dataclass(frozen=True)
class Choices:
    """What chooses code: known when the environment is built."""

    model: VehicleModel = motor.MODEL
    layout: Layout = make_layout(motor.MODEL)  # of the observation
    integrator: str = "euler"  # "euler" | "rk4"
    randomize: bool = False  # draw new constants for every episode
    population: str | None = None  # of the model, that they are drawn from
    terms: UserFunctions = ()  # a user's reward terms, in addition to REWARDS
    rules: UserFunctions = ()  # a user's rules, in addition to TERMINATIONS
    report_passes: bool = False  # to the learner: gates passed, for curricula

    @property
    def rewards(self) -> Mapping[str, Term]:
        """Every term of the reward, by the name of its weight."""
        return {**REWARDS, **{name: user_term(name, term) for name, term in self.terms}}

    @property
    def terminations(self) -> Mapping[str, Callable[[Step], jax.Array | None]]:
        """Every rule that ends an episode as a crash, by the text that says why."""
        added = {f"ended by {name}": user_rule(name, rule) for name, rule in self.rules}
        return {**TERMINATIONS, **added}


class RaceParams(struct.PyTreeNode):
    """Every number of the race. Sections of the config are as leaves, with angles in rad."""

    vehicle: VehicleParams
    track: Track
    reward: Reward
    rules: Rules
    training_limits: TrainingLimits
    start: Start
    disturbance: Disturbance
    randomization: Constants  # largest relative error of each constant
    tracks: Track | None = None  # (tracks, gates) of each number: drawn for every episode
    heading: jax.Array | None = None  # (gates,) rad, center of a start's yaw; None: north
    recorded: RecordedStarts | None = None  # states in which a part of the episodes starts
    population_width: jax.Array | None = None  # 0: the nominal drone; 1: one of the population
    mismatch: Constants | None = None  # factors on the constants of the simulated drone
    estimator: onboard.EstimatorParams | None = None  # where the observation is estimated
    battery: Battery | None = None  # where it limits the commands
    # Scale of the observed disturbances where it is not the drawn range: a policy keeps the scale
    # that it was trained with.
    disturbance_scale: Disturbance | None = None

    @property
    def observed_disturbance(self) -> Disturbance:
        """Half-widths that scale the observed disturbances."""
        return self.disturbance if self.disturbance_scale is None else self.disturbance_scale


class Estimate(struct.PyTreeNode):
    """The onboard estimate of the external disturbance."""

    filter: onboard.EstimatorState
    moment: Vec3  # N m, body
    force: Vec3  # m/s^2, body


class RaceState(struct.PyTreeNode):
    """One drone in its race."""

    drone: State  # of the vehicle model
    target: jax.Array  # () int32, index of the gate to pass next
    step: jax.Array  # () int32, steps since the episode began
    gates_passed: jax.Array  # () int32
    constants: Constants | None  # of this episode, where they are drawn; else None
    estimate: Estimate | None = None  # where the observation is estimated; else None
    action: tuple[jax.Array, ...] | None = None  # of the step before, each (), where it is used
    battery: BatteryState | None = None  # where the race has one
    track: Track | None = None  # of this episode, where it is drawn; else None
    past: Past | None = None  # where a history is observed


def _opaque_true(params: RaceParams) -> jax.Array:
    """A flag that is true but unknown to the compiler; see ``quadjax.core.materialize``."""
    return jnp.asarray(params.training_limits.episode_steps) > 0


def _vehicle_params(params: RaceParams, state: RaceState) -> VehicleParams:
    if state.constants is None:
        return params.vehicle
    return dataclasses.replace(params.vehicle, constants=state.constants)


def on_track(params: RaceParams, track: Track | None) -> RaceParams:
    """The race on the track of one episode, if it has its own."""
    return params if track is None else params.replace(track=track)


def reset(choices: Choices, params: RaceParams, key: jax.Array) -> RaceState:
    """A random start.

    Raises:
        InputError: ``params`` has both random tracks and headings of the starts, which are those of
            ``params.track``.
    """
    track = _draw_track(params, jax.random.fold_in(key, 3))
    params = on_track(params, track)
    size = len(jax.tree.leaves(params.vehicle.constants)) if choices.randomize else 0
    draws = starts.draw_start(choices.model, key, size)
    constants = _drawn_constants(choices, params, draws.constants)
    drone, target = _drawn_start(choices, params, constants, draws, key)
    zero = clock = jnp.zeros((), jnp.int32)
    if params.start.stagger_clocks:
        steps = jnp.asarray(params.training_limits.episode_steps, draws.clock.dtype)
        clock = (0.5 * (draws.clock + 1.0) * steps).astype(jnp.int32)
    action = no_action(choices, params)
    state = RaceState(drone, target, clock, zero, constants, action=action, track=track)
    if params.battery is not None:
        rpm, battery_key = choices.model.actuator_state(drone), jax.random.fold_in(key, 2)
        state = state.replace(battery=draw_battery(params.battery, rpm, battery_key))
    return with_memory(choices, params, state)


def _draw_track(params: RaceParams, key: jax.Array) -> Track | None:
    """One of the random tracks, all with the same chance; None where there are none."""
    tracks = params.tracks
    if tracks is None:
        return None
    if params.heading is not None:
        raise InputError("params.heading is set, allowed: None with params.tracks")
    index = jax.random.randint(key, (), 0, tracks.yaw.shape[0])
    return jax.tree.map(lambda numbers: numbers[index], tracks)


def _drawn_start(
    choices: Choices,
    params: RaceParams,
    constants: Constants | None,
    draws: Draws,
    key: jax.Array,
) -> tuple[State, jax.Array]:
    """The vehicle's state at a random start, and the gate to pass next."""
    ranges, target = params.start, jnp.zeros((), jnp.int32)
    if ranges.gate == "random":
        target = starts.start_gate(params.track, draws.gate)
    recorded = None
    if params.recorded is not None:
        recorded = draw_recorded(params.recorded, jax.random.fold_in(key, 4))
        target = jnp.where(recorded.used, recorded.target, target)
    fraction = None
    if ranges.along_leg is not None:
        fraction = ranges.along_leg * jax.random.uniform(jax.random.fold_in(key, 1))
    motion = starts.start_motion(params.track, ranges, params.heading, target, draws, fraction)
    nominal = params.vehicle.constants if constants is None else constants
    drone = starts.start(
        choices.model, nominal, motion, ranges.thrust, params.disturbance, draws, recorded
    )
    if ranges.race is None:
        return drone, target
    race_key, used_key = jax.random.split(jax.random.fold_in(key, 5))
    first = race_drone(choices, params, constants, drone, starts.draw(race_key, 3))
    race = functools.partial(jnp.where, jax.random.uniform(used_key) < ranges.race)
    return jax.tree.map(race, (first, jnp.zeros_like(target)), (drone, target))


def _drawn_constants(choices: Choices, params: RaceParams, numbers: jax.Array) -> Constants | None:
    """The constants of one episode, of numbers (n,) in [-1, 1]; None: those of ``params``."""
    constants, drawn = params.vehicle.constants, None
    if params.mismatch is not None:
        drawn = constants = jax.tree.map(jnp.multiply, constants, params.mismatch)
    if not choices.randomize:
        return drawn
    if choices.population is None:
        return starts.draw_constants(constants, params.randomization, numbers)
    assert params.population_width is not None
    drone = choices.model.populations[choices.population](constants, numbers)
    return starts.towards(constants, drone, params.population_width)


def no_action(choices: Choices, params: RaceParams) -> tuple[jax.Array, ...] | None:
    """The action before the first, where the observation or the reward needs it."""
    observed = LAST_ACTION in (split_name(name)[0] for name in choices.layout.names)
    if not observed and params.reward.action_change is None:
        return None
    return tuple(jnp.zeros(()) for _ in range(choices.model.action_size))


def with_memory(choices: Choices, params: RaceParams, state: RaceState) -> RaceState:
    """The state with what is kept on board as it is at a start.

    A fresh estimate of the disturbance, where the race has an estimator; a history full of this
    state, where one is observed.
    """
    state = state.replace(past=begin_past(choices.layout, state))
    if params.estimator is None:
        return state
    measured = choices.model.measure(_vehicle_params(params, state), state.drone)
    fresh = onboard.init(params.estimator, measured)
    return state.replace(estimate=Estimate(fresh, Vec3.zero(), Vec3.zero()))


def race_drone(
    choices: Choices,
    params: RaceParams,
    constants: Constants | None,
    disturbed: State | None,
    moved: jax.Array | None,
) -> State:
    """A drone at the start of a timed race, with the disturbances of ``disturbed``.

    ``moved``: see ``quadjax.race.starts.hover``.
    """
    model = choices.model
    drone = starts.hover(model, constants or params.vehicle.constants, params.track, moved)
    if disturbed is None or not model.disturbed:
        return drone
    return model.with_disturbance(drone, *model.disturbance(disturbed))


def hover_start(
    choices: Choices,
    params: RaceParams,
    start: RaceState | None = None,
    moved: jax.Array | None = None,
) -> RaceState:
    """The start of a timed race: hover at the track's start, or the last gate.

    Args:
        choices: of the race.
        params: of the race.
        start: its constants, disturbances and battery are used; None: nothing is drawn, and the
            battery has the highest charge.
        moved: (3,) numbers of a start around that place; see ``quadjax.race.starts.hover``.
    """
    zero = jnp.zeros((), jnp.int32)
    constants, charged, disturbed = None, None, None
    if start is not None:
        constants, charged, disturbed = start.constants, start.battery, start.drone
    drone = race_drone(choices, params, constants, disturbed, moved)
    before = no_action(choices, params)
    state = RaceState(drone, zero, zero, zero, constants, action=before)
    if params.battery is not None:
        rpm = choices.model.actuator_state(drone)
        state = state.replace(battery=battery_at_start(params.battery, rpm, charged))
    return with_memory(choices, params, state)


def observe(choices: Choices, params: RaceParams, state: RaceState) -> jax.Array:
    """The observation (layout.size,); see ``quadjax.race.observations``."""
    params = on_track(params, state.track)
    opaque_true = _opaque_true(params)
    g = call_materialized(gate, opaque_true, params.track, state.target)
    return jnp.stack(
        call_materialized(functools.partial(_numbers, choices), opaque_true, params, state, g)
    )


def _numbers(choices: Choices, params: RaceParams, state: RaceState, g: Gate) -> list[jax.Array]:
    return choices.layout.numbers(Step(choices.model, params, state, g))


def command(choices: Choices, params: RaceParams, action: jax.Array) -> Command:
    """The command of an action (action_size,): clipped to [-1, 1], scaled to the nominal range."""
    size = choices.model.action_size
    parts = [clip_inward(action[index], -1.0, 1.0) for index in range(size)]
    low, high = choices.model.command_range(params.vehicle.constants)
    unit = jax.tree.unflatten(jax.tree.structure(low), parts)
    return jax.tree.map(lambda u, lo, hi: lo + 0.5 * (hi - lo) * (u + 1.0), unit, low, high)


def _simulate(choices: Choices, params: RaceParams, state: RaceState, action: jax.Array) -> State:
    """The vehicle's state one step later; commands are clipped to its range."""
    vehicle, model = _vehicle_params(params, state), choices.model
    low, high = model.command_range(vehicle.constants)
    held = jax.tree.map(clip_inward, command(choices, params, action), low, high)
    if params.battery is not None and state.battery is not None:
        rpm = model.actuator_state(state.drone)
        held = limit_command(params.battery, state.battery, rpm, held)
    opaque_true = _opaque_true(params)
    # A step of Euler's method starts from the carry of a loop, which is in memory already.
    begin = materialize_cotangent if choices.integrator == "euler" else materialize
    vehicle = dataclasses.replace(vehicle, opaque_true=opaque_true)
    after = INTEGRATORS[choices.integrator](
        lambda drone: model.derivative(vehicle, begin(drone, opaque_true), held),
        state.drone,
        params.rules.time_step,
    )
    return model.wrap(model.hold(after, held))


def evaluate_rules(
    choices: Choices, params: RaceParams, state: RaceState, after: State, g: Gate
) -> Outcome:
    """The events of a step from ``state`` to the vehicle state ``after``, before any reset."""
    return judge(Step(choices.model, params, state, g, after), choices.terminations)


def transition(
    choices: Choices, params: RaceParams, state: RaceState, action: jax.Array
) -> tuple[RaceState, jax.Array, Outcome]:
    """One step with its events.

    Returns:
        The next state, the reward () and the outcome. A state that is not finite is replaced by
        the state before it, so that no NaN propagates; the outcome reports it.
    """
    params = on_track(params, state.track)
    opaque_true = _opaque_true(params)
    after = call_materialized(
        functools.partial(_simulate, choices), opaque_true, params, state, action
    )
    g = call_materialized(gate, opaque_true, params.track, state.target)
    outcome = call_materialized(
        functools.partial(evaluate_rules, choices), opaque_true, params, state, after, g
    )
    invalid = outcome.crashes[NOT_FINITE]
    drone = jax.tree.map(lambda new, old: jnp.where(invalid, old, new), after, state.drone)
    step = Step(choices.model, params, state, g, drone, outcome, action)
    value = reward(step, choices.rewards)
    following = progressed(params, state, drone, outcome)
    if params.battery is not None and state.battery is not None:
        rpm, sent = choices.model.actuator_state(drone), command(choices, params, action)
        charged = advance_battery(params.battery, state.battery, rpm, sent)
        following = following.replace(battery=charged)
    following = following.replace(
        estimate=_estimate(choices, params, state, drone),
        action=None if state.action is None else applied(choices, action),
        past=push_past(state.past, state),
    )
    return following, value, outcome


def applied(choices: Choices, action: jax.Array) -> tuple[jax.Array, ...]:
    """The numbers of an action, clipped to [-1, 1], without a gradient beyond the limits."""
    return tuple(jnp.clip(action[i], -1.0, 1.0) for i in range(choices.model.action_size))


def progressed(params: RaceParams, state: RaceState, drone: State, outcome: Outcome) -> RaceState:
    """The race one step later: vehicle state, target, step count and gates passed."""
    one = outcome.passed.astype(jnp.int32)
    advanced = state.target + one
    target = jnp.where(advanced == gate_count(params.track), 0, advanced)
    passed = state.gates_passed + one
    return state.replace(drone=drone, target=target, step=state.step + 1, gates_passed=passed)


def _estimate(
    choices: Choices, params: RaceParams, state: RaceState, drone: State
) -> Estimate | None:
    """The estimate after this step's measurement; no gradient flows through the filter."""
    if state.estimate is None or params.estimator is None:
        return None
    measured = choices.model.measure(_vehicle_params(params, state), drone)
    measured = jax.lax.stop_gradient(measured)
    return Estimate(*onboard.update(params.estimator, state.estimate.filter, measured))


def exact_rules(model: VehicleModel, params: RaceParams) -> RaceParams:
    """The race without training limits: no gate inflation, any roll, any valid pitch.

    It is on ``params.track``, also where the episodes of training are on random tracks. Clocks
    start at zero.
    """
    pitch = jnp.float32(model.pitch_limit) if math.isfinite(model.pitch_limit) else None
    limits = with_leaves(
        params.training_limits,
        gate_inflation=jnp.zeros(()),
        pitch_deg=pitch,
        roll_deg=None,
        yaw_rate=None,
    )
    start = with_leaves(params.start, stagger_clocks=False)
    return params.replace(training_limits=limits, start=start, tracks=None)


def make_environment(choices: Choices) -> Environment[RaceParams, RaceState]:
    """The environment of ``choices`` with the interface that learners use."""

    def step(
        params: RaceParams, state: RaceState, action: jax.Array
    ) -> tuple[RaceState, jax.Array, jax.Array, jax.Array]:
        following, value, outcome = transition(choices, params, state, action)
        return following, value, outcome.over, outcome.truncated

    def completed(before: RaceState, after: RaceState) -> jax.Array:
        return (after.gates_passed - before.gates_passed).astype(jnp.float32)

    return Environment(
        completed=completed if choices.report_passes else None,
        reset=lambda params, key: reset(choices, params, key),
        observe=lambda params, state: observe(choices, params, state),
        step=step,
        observation_size=choices.layout.size,
        action_size=choices.model.action_size,
    )


def with_critic_constants(
    environment: Environment[RaceParams, RaceState], spread: Sequence[tuple[str, float]]
) -> Environment[RaceParams, RaceState]:
    """The environment whose observation ends with the drawn constants, for the critic alone.

    An asymmetric actor-critic (Pinto et al., 2017, arXiv 1710.06542): the policy's network does not
    take these numbers. Each is its relative error, divided by the largest one that is drawn.

    Args:
        environment: of the race, which draws constants.
        spread: names of the drawn constants and the largest relative error of each; 1 where their
            population has no such number.
    """

    def observe(params: RaceParams, state: RaceState) -> jax.Array:
        assert state.constants is not None
        constants, nominal = values_of(state.constants), values_of(params.vehicle.constants)
        errors = []
        for name, largest in spread:
            value = nominal[name]
            size = jnp.where(value == 0.0, 1.0, jnp.abs(value))
            errors.append((constants[name] - value) / (size * largest))
        return jnp.concatenate([environment.observe(params, state), jnp.stack(errors)])

    size = environment.observation_size + len(spread)
    return dataclasses.replace(environment, observe=observe, observation_size=size)
