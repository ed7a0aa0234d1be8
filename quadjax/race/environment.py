"""The racing environment: vehicle, track, rules and starts as three pure functions of one drone.

``quadjax.race.types`` has its static ``Choices``, its traced ``RaceParams`` and its ``RaceState``.

Read ``once(f, *args)`` as ``f(*args)``: it only stops XLA's CPU backend from computing it again for
every use (``quadjax.core.materialize``).
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp

from quadjax.core.environment import Environment
from quadjax.core.gradients import clip_inward
from quadjax.core.integrators import INTEGRATORS
from quadjax.core.materialize import materialize, materialize_cotangent, materializing
from quadjax.core.precision import single_precision
from quadjax.core.sharing import bound, cached
from quadjax.core.traced import with_leaves
from quadjax.race.episode import reset
from quadjax.race.rewards import clipped_action, reward
from quadjax.race.rules import NOT_FINITE, evaluate_rules
from quadjax.race.track import gate, gate_count
from quadjax.race.types import Choices, Estimate, Outcome, RaceParams, RaceState, Step
from quadjax.vehicle import estimator
from quadjax.vehicle.battery import advance_battery, limit_command
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.protocol import Command, State, VehicleModel


def observe(choices: Choices, params: RaceParams, state: RaceState) -> jax.Array:
    """The observation (layout.size,); see ``quadjax.race.observations``."""
    params = params.on_track(state.track)
    once = materializing(params.opaque_true, gradients=True)
    step = Step(choices.model, params, state, once(gate, params.track, state.target))
    numbers = jnp.stack(once(bound(_numbers, choices), step))
    return numbers if params.observation_scale is None else numbers * params.observation_scale


# ``choices`` is an argument of what is materialized, so that no trace with code of a user is kept.
def _numbers(choices: Choices, step: Step) -> list[jax.Array]:
    return choices.layout.numbers(step)


def _outcome(choices: Choices, step: Step) -> Outcome:
    return evaluate_rules(step, choices.user_rules)


def command(
    choices: Choices, params: RaceParams, action: jax.Array | tuple[jax.Array, ...]
) -> Command:
    """The command of an action (action_size,): clipped to [-1, 1], scaled to the nominal range."""
    size = choices.model.action_size
    parts = [clip_inward(action[index], -1.0, 1.0) for index in range(size)]
    low, high = choices.model.command_range(params.vehicle.constants)
    unit = jax.tree.unflatten(jax.tree.structure(low), parts)
    return jax.tree.map(lambda u, lo, hi: lo + 0.5 * (hi - lo) * (u + 1.0), unit, low, high)


def _simulate(choices: Choices, params: RaceParams, state: RaceState, action: jax.Array) -> State:
    """The vehicle's state one step later; commands are clipped to its range.

    With a delay, the mean over the step of the previous and the present command acts, because the
    vehicle is slower than a step.
    """
    vehicle, model = params.vehicle_of(state), choices.model
    low, high = model.command_range(vehicle.constants)
    held = jax.tree.map(clip_inward, command(choices, params, action), low, high)
    if state.delay is not None and state.action is not None:
        before = jax.tree.map(clip_inward, command(choices, params, state.action), low, high)
        late = state.delay / params.rules.time_step
        held = jax.tree.map(lambda now, old: now + late * (old - now), held, before)
    if params.battery is not None and state.battery is not None:
        rpm = state.drone.actuators
        held = limit_command(params.battery, state.battery, rpm, held)
    opaque_true = params.opaque_true
    # A step of Euler's method starts from the carry of a loop, which is in memory already.
    begin = materialize_cotangent if choices.integrator == "euler" else materialize
    vehicle = dataclasses.replace(vehicle, opaque_true=opaque_true)
    after = INTEGRATORS[choices.integrator](
        lambda drone: model.derivative(vehicle, begin(drone, opaque_true), held),
        state.drone,
        params.rules.time_step,
    )
    return after.wrapped()


def transition(
    choices: Choices, params: RaceParams, state: RaceState, action: jax.Array
) -> tuple[RaceState, jax.Array, Outcome]:
    """One step with its events.

    Returns:
        The next state, the reward () and the outcome. A state that is not finite is replaced by
        the state before it, so that no NaN propagates; the outcome reports it.
    """
    params, model = params.on_track(state.track), choices.model
    once = materializing(params.opaque_true, gradients=True)
    after = once(bound(_simulate, choices), params, state, action)
    g = once(gate, params.track, state.target)
    outcome = once(bound(_outcome, choices), Step(model, params, state, g, after))
    invalid = outcome.crashes[NOT_FINITE]
    drone = jax.tree.map(lambda new, old: jnp.where(invalid, old, new), after, state.drone)
    value = reward(Step(model, params, state, g, drone, outcome, action), choices.user_terms)
    following, battery = progressed(params, state, drone, outcome), state.battery
    if params.battery is not None and battery is not None:
        sent = command(choices, params, action)
        battery = advance_battery(params.battery, battery, drone.actuators, sent)
    following = following.replace(
        battery=battery,
        estimate=_estimate(choices, params, state, drone),
        action=None if state.action is None else clipped_action(action),
    )
    return following, value, outcome


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
    before = state.estimate
    if before is None or before.filter is None or params.estimator is None:
        return None
    measured = jax.lax.stop_gradient(choices.model.measure(params.vehicle_of(state), drone))
    return Estimate(*estimator.update(params.estimator, before.filter, measured))


def exact_rules(model: VehicleModel, params: RaceParams) -> RaceParams:
    """The race without training limits: no gate inflation, any roll, yaw rate and valid pitch.

    It is on ``params.track``, also where the episodes of training are on random tracks. Clocks
    start at zero. The length of an episode stays. The observation is not scaled: the first layer of
    a policy has the factors.
    """
    pitch = math.degrees(model.pitch_limit)
    limits = {
        "gate_inflation": jnp.zeros(()),
        "pitch_deg": jnp.float32(pitch) if math.isfinite(pitch) else None,
        "roll_deg": None,
        "yaw_rate": None,
    }
    return params.replace(
        training_limits=with_leaves(params.training_limits, **limits),
        start=with_leaves(params.start, stagger_clocks=False),
        tracks=None,
        observation_scale=None,
    )


@cached
def make_environment(choices: Choices) -> Environment[RaceParams, RaceState]:
    """The environment of ``choices`` with the interface that learners use."""

    @single_precision
    def step(
        params: RaceParams, state: RaceState, action: jax.Array
    ) -> tuple[RaceState, jax.Array, jax.Array, jax.Array]:
        following, value, outcome = transition(choices, params, state, action)
        return following, value, outcome.over, outcome.truncated

    def completed(before: RaceState, after: RaceState) -> jax.Array:
        return (after.gates_passed - before.gates_passed).astype(jnp.float32)

    return Environment(
        completed=completed if choices.report_passes else None,
        reset=single_precision(functools.partial(reset, choices)),
        observe=single_precision(functools.partial(observe, choices)),
        step=step,
        observation_size=choices.layout.size,
        action_size=choices.model.action_size,
    )


@cached
def with_critic_constants(
    environment: Environment[RaceParams, RaceState], spread: tuple[tuple[str, float], ...]
) -> Environment[RaceParams, RaceState]:
    """The environment whose observation ends with the drawn constants, for the critic alone.

    An asymmetric actor-critic (Pinto et al., 2017, arXiv 1710.06542): the policy's network does not
    take these numbers. ``spread`` has the names of drawn constants and the largest relative error
    of each (1 where a population has no such number); observed are relative errors, divided by it.
    """

    def observe(params: RaceParams, state: RaceState) -> jax.Array:
        constants, nominal = values_of(state.constants), values_of(params.vehicle.constants)
        errors = []
        for name, largest in spread:
            value = nominal[name]
            size = jnp.where(value == 0.0, 1.0, jnp.abs(value))
            errors.append((constants[name] - value) / (size * largest))
        return jnp.concatenate([environment.observe(params, state), jnp.stack(errors)])

    size = environment.observation_size + len(spread)
    return dataclasses.replace(environment, observe=observe, observation_size=size)
