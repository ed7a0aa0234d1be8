"""The racing environment: vehicle, track, rules and starts as three pure functions of one drone.

``Choices`` are static (they choose code); ``RaceParams`` are traced (they are numbers).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.environment import Environment
from quadjax.core.errors import InputError
from quadjax.core.gradients import clip_inward
from quadjax.core.imports import name_of, own_numbers
from quadjax.core.integrators import INTEGRATORS
from quadjax.core.materialize import (
    call_materialized,
    materialize,
    materialize_cotangent,
)
from quadjax.core.vectors import Vec3, safe_norm
from quadjax.race import battery, history, rules, start
from quadjax.race.battery import BatteryState, RaceBattery
from quadjax.race.context import StepContext
from quadjax.race.history import Past
from quadjax.race.layout import LAST_ACTION, Layout, View, make_layout
from quadjax.race.recorded_starts import draw_recorded
from quadjax.race.track import Gate, Track, gate, gate_count
from quadjax.vehicle import estimator as onboard
from quadjax.vehicle import motor
from quadjax.vehicle.protocol import Command, Constants, State, VehicleModel, VehicleParams

Kept = TypeVar("Kept")
Term = Callable[[StepContext], jax.Array]  # -> () float
Rule = Callable[[StepContext], jax.Array]  # -> () bool


@dataclasses.dataclass(frozen=True)
class Choices:
    """What chooses code: known when the environment is built."""

    model: VehicleModel = motor.MODEL
    layout: Layout = make_layout(motor.MODEL)  # of the observation
    integrator: str = "euler"  # "euler" | "rk4"
    gate_test: str = "square"  # "square" | "world_box" | "interpolated"
    random_gate: bool = False  # start at any gate rather than the last
    stagger_clocks: bool = False  # episodes start at a random step of their clock
    randomize: bool = False  # draw new constants for every episode
    population: str | None = None  # of the model, that they are drawn from
    mismatch: bool = False  # the simulated drone has other constants than the policy's model
    terms: tuple[Term, ...] = ()  # reward terms besides those of RewardWeights
    rules: tuple[Rule, ...] = ()  # rules besides those of Limits
    report_passes: bool = False  # to the learner: gates passed, for curricula


@struct.dataclass
class RaceParams:
    """Every number of the race."""

    vehicle: VehicleParams
    track: Track
    limits: rules.Limits
    reward: rules.RewardWeights
    start: start.StartRange
    disturbance: start.DisturbanceRange
    randomization: Constants  # largest relative error of each constant
    tracks: Track | None = None  # (tracks, gates) of each number: drawn for every episode
    population_width: jax.Array | None = None  # 0: the nominal drone; 1: one of the population
    mismatch: Constants | None = None  # factors on the constants of the simulated drone
    estimator: onboard.EstimatorParams | None = None  # where the observation is estimated
    battery: RaceBattery | None = None  # where it limits the commands
    term_weights: tuple[jax.Array, ...] = ()  # of Choices.terms, each ()
    # Scale of the observed disturbances where it is not the drawn range: a policy keeps the scale
    # that it was trained with.
    disturbance_scale: start.DisturbanceRange | None = None

    @property
    def observed_disturbance(self) -> start.DisturbanceRange:
        """Half-widths that scale the observed disturbances."""
        return self.disturbance if self.disturbance_scale is None else self.disturbance_scale


@struct.dataclass
class Estimate:
    """The onboard estimate of the external disturbance."""

    filter: onboard.EstimatorState
    moment: Vec3  # N m, body
    force: Vec3  # m/s^2, body


@struct.dataclass
class RaceState:
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
    track_index: jax.Array | None = None  # () int32 of this track
    past: Past | None = None  # where a history is observed


def _opaque_true(params: RaceParams) -> jax.Array:
    """A flag that is true but unknown to the compiler; see ``quadjax.core.materialize``."""
    return params.limits.episode_steps > 0


def _vehicle_params(params: RaceParams, state: RaceState) -> VehicleParams:
    if state.constants is None:
        return params.vehicle
    return params.vehicle.replace(constants=state.constants)


def on_track(params: RaceParams, track: Track | None) -> RaceParams:
    """The race on the track of one episode, if it has its own."""
    return params if track is None else params.replace(track=track)


def _draw_track(tracks: Track, key: jax.Array) -> tuple[Track, jax.Array]:
    """One of several tracks, and its index."""
    index = jax.random.randint(key, (), 0, tracks.yaw.shape[0])
    return jax.tree.map(lambda numbers: numbers[index], tracks), index


def reset(choices: Choices, params: RaceParams, key: jax.Array) -> RaceState:
    """A random start.

    Raises:
        InputError: ``params`` has both random tracks and headings of the starts, which are those of
            ``params.track``.
    """
    track, index = None, None
    if params.tracks is not None:
        if params.start.heading is not None:
            raise InputError("params.start.heading is set, allowed: None with params.tracks")
        track_key = jax.random.fold_in(key, 3)
        track, index = _draw_track(params.tracks, track_key)
        params = on_track(params, track)
    constants = params.vehicle.constants
    extra = len(jax.tree.leaves(constants)) if choices.randomize else 0
    own_draws = 2 + start.draw_count(choices.model)
    drawn = start.draw(key, own_draws + extra)
    target = clock = jnp.zeros((), jnp.int32)
    if choices.random_gate:
        target = start.start_gate(params.track, drawn[0])
    if choices.stagger_clocks:
        most = params.limits.episode_steps.astype(drawn.dtype)
        clock = (0.5 * (drawn[1] + 1.0) * most).astype(jnp.int32)
    own = _own_constants(choices, params, drawn[own_draws:])
    recorded = None
    if params.start.recorded is not None:
        recorded = draw_recorded(params.start.recorded, jax.random.fold_in(key, 4))
        target = jnp.where(recorded.used, recorded.target, target)
    part = None
    if params.start.along_leg is not None:
        part = params.start.along_leg * jax.random.uniform(jax.random.fold_in(key, 1))
    drone = start.start(
        choices.model,
        constants if own is None else own,
        params.track,
        params.start,
        params.disturbance,
        target,
        drawn[2:own_draws],
        part,
        recorded,
    )
    if params.start.race is not None:
        race_key, used_key = jax.random.split(jax.random.fold_in(key, 5))
        first = race_drone(choices, params, own, drone, start.draw(race_key, 3))
        race = functools.partial(jnp.where, jax.random.uniform(used_key) < params.start.race)
        drone, target = jax.tree.map(race, (first, jnp.zeros_like(target)), (drone, target))
    zero = jnp.zeros((), jnp.int32)
    before = no_action(choices, params)
    state = RaceState(
        drone, target, clock, zero, own, action=before, track=track, track_index=index
    )
    if params.battery is not None:
        rpm, own_key = choices.model.actuator_state(drone), jax.random.fold_in(key, 2)
        state = state.replace(battery=battery.drawn(params.battery, rpm, own_key))
    return with_memory(choices, params, state)


def _own_constants(choices: Choices, params: RaceParams, numbers: jax.Array) -> Constants | None:
    """The constants of one episode, of numbers (n,) in [-1, 1]; None: those of ``params``."""
    constants, own = params.vehicle.constants, None
    if choices.mismatch:
        own = constants = jax.tree.map(jnp.multiply, constants, params.mismatch)
    if not choices.randomize:
        return own
    if choices.population is None:
        return start.draw_constants(constants, params.randomization, numbers)
    drone = choices.model.populations[choices.population](constants, numbers)
    return start.towards(constants, drone, params.population_width)


def no_action(choices: Choices, params: RaceParams) -> tuple[jax.Array, ...] | None:
    """The action before the first, where the observation or the reward needs it."""
    observed = LAST_ACTION in (history.split_name(name)[0] for name in choices.layout.names)
    if not observed and params.reward.action_change is None:
        return None
    return tuple(jnp.zeros(()) for _ in range(choices.model.action_size))


def with_memory(choices: Choices, params: RaceParams, state: RaceState) -> RaceState:
    """The state with what is kept on board as it is at a start.

    A fresh estimate of the disturbance, where the race has an estimator; a history full of this
    state, where one is observed.
    """
    past = history.begin(choices.layout.names, state.drone, state.action)
    state = state.replace(past=past)
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
    drawn: jax.Array | None,
) -> State:
    """A drone at the start of a timed race, with the disturbances of ``disturbed``.

    ``drawn``: see ``quadjax.race.start.hover``.
    """
    model = choices.model
    drone = start.hover(model, constants or params.vehicle.constants, params.track, drawn)
    if disturbed is None or not model.disturbed:
        return drone
    return model.with_disturbance(drone, *model.disturbance(disturbed))


def hover_start(
    choices: Choices,
    params: RaceParams,
    drawn: RaceState | None = None,
    moved: jax.Array | None = None,
) -> RaceState:
    """The start of a timed race: hover at the track's start, or the last gate.

    Args:
        choices: of the race.
        params: of the race.
        drawn: its constants, disturbances and battery are used; None: nothing is drawn, and the
            battery has the highest charge.
        moved: (3,) numbers of a start around that place; see ``quadjax.race.start.hover``.
    """
    zero = jnp.zeros((), jnp.int32)
    constants, charged, disturbed = None, None, None
    if drawn is not None:
        constants, charged, disturbed = drawn.constants, drawn.battery, drawn.drone
    drone = race_drone(choices, params, constants, disturbed, moved)
    before = no_action(choices, params)
    state = RaceState(drone, zero, zero, zero, constants, action=before)
    if params.battery is not None:
        rpm = choices.model.actuator_state(drone)
        state = state.replace(battery=battery.at_start(params.battery, rpm, charged))
    return with_memory(choices, params, state)


def observe(choices: Choices, params: RaceParams, state: RaceState) -> jax.Array:
    """The observation (layout.size,); see ``quadjax.race.layout``."""
    params = on_track(params, state.track)
    opaque_true = _opaque_true(params)
    g = call_materialized(gate, opaque_true, params.track, state.target)
    return jnp.stack(
        call_materialized(functools.partial(_numbers, choices), opaque_true, params, state, g)
    )


def _numbers(choices: Choices, params: RaceParams, state: RaceState, g: Gate) -> list[jax.Array]:
    return choices.layout.numbers(View(choices.model, params, state, g))


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
        held = battery.limit(params.battery, state.battery, rpm, held)
    opaque_true = _opaque_true(params)
    # A step of Euler's method starts from the carry of a loop, which is in memory already.
    begin = materialize_cotangent if choices.integrator == "euler" else materialize
    vehicle = vehicle.replace(opaque_true=opaque_true)
    after = INTEGRATORS[choices.integrator](
        lambda drone: model.derivative(vehicle, begin(drone, opaque_true), held),
        state.drone,
        params.limits.time_step,
    )
    return model.wrap(model.hold(after, held))


def _finite(drone: State) -> jax.Array:
    return jnp.isfinite(sum(jax.tree.leaves(drone)))


def evaluate_rules(
    choices: Choices, params: RaceParams, state: RaceState, after: State, g: Gate
) -> rules.Outcome:
    """The events of a step from ``state`` to the vehicle state ``after``, before any reset."""
    limits = params.limits
    model = choices.model
    position, rates, euler = model.position(after), model.rates(after), model.euler(after)
    inflation, radius = limits.gate_inflation, limits.body_radius
    opening, radius = (inflation, 0.0) if radius is None else (inflation - radius, radius)
    before = model.position(state.drone)
    passed, hit = rules.crossing(before, position, g, opening, choices.gate_test)
    outside = (jnp.abs(position.x) > limits.position) | (jnp.abs(position.y) > limits.position)
    if limits.bounds is not None:
        outside = outside | rules.outside_box(position, limits.bounds, radius)
    if limits.frame is not None:
        wider = jnp.maximum(inflation, 0.0)
        hit = hit | rules.inside_frame(position, params.track, limits.frame, wider, radius)
    outcome = rules.Outcome(
        passed=passed,
        gate_collision=hit,
        ground=rules.hits_ground(position, model.velocity(after), limits.landing, radius),
        out_of_bounds=outside,
        body_rate=rules.too_fast(rates, limits),
        yaw_rate=jnp.abs(rates.z) > limits.yaw_rate,
        attitude=(jnp.abs(euler.y) > limits.pitch) | (jnp.abs(euler.x) > limits.roll),
        non_finite=~_finite(after),
        truncated=state.step + 1 >= limits.episode_steps,
        extra_rule=_extra_rule(choices, params, state, after, g),
        overspeed=None if limits.speed is None else safe_norm(model.velocity(after)) > limits.speed,
    )
    ended = outcome.terminated
    outcome = outcome.replace(passed=passed & ~ended, truncated=outcome.truncated & ~ended)
    if params.track.closed:
        return outcome
    finished = outcome.passed & (state.target == gate_count(params.track) - 1)
    return outcome.replace(finished=finished, truncated=outcome.truncated & ~finished)


def _extra_rule(
    choices: Choices, params: RaceParams, state: RaceState, after: State, g: Gate
) -> jax.Array | None:
    context = StepContext(choices.model, params, state, after, g)
    ended = [
        jnp.asarray(own_numbers(f"rule {name_of(rule)}", rule, context)[0], bool)
        for rule in choices.rules
    ]
    return functools.reduce(jnp.logical_or, ended) if ended else None


def transition(
    choices: Choices, params: RaceParams, state: RaceState, action: jax.Array
) -> tuple[RaceState, jax.Array, rules.Outcome]:
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
    drone = jax.tree.map(
        lambda new, old: jnp.where(outcome.non_finite, old, new), after, state.drone
    )
    weights, radius = params.reward, params.limits.body_radius
    if radius is not None:  # the required clearance is that of the drone's edge
        weights = weights.replace(gate_edge_margin=weights.gate_edge_margin + radius)
    value = rules.reward(
        weights,
        outcome,
        choices.model.position(state.drone),
        choices.model.position(drone),
        choices.model.euler(drone).y,
        choices.model.rates(drone),
        g,
        params.limits.time_step,
        params.limits.gate_inflation,
    )
    context = StepContext(choices.model, params, state, drone, g, outcome, action)
    for weight, term in zip(params.term_weights, choices.terms, strict=True):
        (number,) = own_numbers(f"reward term {name_of(term)}", term, context)
        value = value + weight * jnp.asarray(number, value.dtype)
    given = applied(choices, action) if state.action is not None else None
    for penalty in _penalties(choices.model, params, state, drone, g, outcome, given):
        value = value - penalty
    following = progressed(params, state, drone, outcome)
    if params.battery is not None and state.battery is not None:
        rpm, sent = choices.model.actuator_state(drone), command(choices, params, action)
        charged = battery.advance(params.battery, state.battery, rpm, sent)
        following = following.replace(battery=charged)
    estimate = _estimate(choices, params, state, drone)
    past = history.push(state.past, state.drone, state.action)
    return following.replace(estimate=estimate, action=given, past=past), value, outcome


def applied(choices: Choices, action: jax.Array) -> tuple[jax.Array, ...]:
    """The numbers of an action, clipped to [-1, 1], without a gradient beyond the limits."""
    return tuple(jnp.clip(action[i], -1.0, 1.0) for i in range(choices.model.action_size))


def _penalties(
    model: VehicleModel,
    params: RaceParams,
    state: RaceState,
    drone: State,
    g: Gate,
    outcome: rules.Outcome,
    action: tuple[jax.Array, ...] | None,
) -> list[jax.Array]:
    """The penalties, each (), that are computed only where they are used."""
    found = []
    sight, change = params.reward.perception, params.reward.action_change
    if sight is not None:
        seen = model.to_body(drone, g.position - model.position(drone))
        penalty = params.limits.time_step * rules.perception_penalty(sight, seen)
        found.append(jnp.where(outcome.passed, 0.0, penalty))
    if params.reward.overspeed is not None:
        rate = rules.overspeed_penalty(
            params.reward.overspeed, params.reward.progress, model.velocity(drone)
        )
        found.append(params.limits.time_step * rate)
    if change is not None:
        assert action is not None and state.action is not None
        found.append(change * rules.action_change(action, state.action))
    return found


def progressed(
    params: RaceParams, state: RaceState, drone: State, outcome: rules.Outcome
) -> RaceState:
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
    if state.estimate is None:
        return None
    measured = choices.model.measure(_vehicle_params(params, state), drone)
    measured = jax.lax.stop_gradient(measured)
    return Estimate(*onboard.update(params.estimator, state.estimate.filter, measured))


def exact_rules(model: VehicleModel, params: RaceParams) -> RaceParams:
    """The race without training limits: no gate inflation, any roll, any valid pitch.

    It is on ``params.track``, also where the episodes of training are on random tracks.
    """
    limits = params.limits.replace(
        gate_inflation=jnp.zeros(()),
        pitch=jnp.asarray(model.pitch_limit, jnp.float32),
        roll=jnp.asarray(jnp.inf, jnp.float32),
        yaw_rate=jnp.asarray(jnp.inf, jnp.float32),
    )
    return params.replace(limits=limits, tracks=None)


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
