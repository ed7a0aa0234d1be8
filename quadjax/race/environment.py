"""The racing environment ``Race``: vehicle, track, rules and starts as pure functions of one drone.

``quadjax.race.types`` has its traced ``RaceParams`` and its ``RaceState``. Ignore ``opaque_true``
while reading: it changes no value, only the speed on CPUs (``quadjax.core.materialize``).
"""

import dataclasses
import math

import jax
import jax.numpy as jnp

from quadjax.core.environment import Environment
from quadjax.core.gradients import clip_inward
from quadjax.core.integrators import INTEGRATORS
from quadjax.core.materialize import materialize, materialize_cotangent, materialized
from quadjax.core.precision import single_precision
from quadjax.race import episode
from quadjax.race.layout import LAST_ACTION, Layout
from quadjax.race.memory import advance_memories
from quadjax.race.observations import command_range
from quadjax.race.rewards import reward
from quadjax.race.rules import NOT_FINITE, evaluate_rules
from quadjax.race.track import gate, gate_count
from quadjax.race.types import (
    Outcome,
    RaceParams,
    RaceState,
    Step,
    UserFunctions,
    describe_dependents,
)
from quadjax.vehicle.battery import advance_battery, limit_command
from quadjax.vehicle.constants import values_of
from quadjax.vehicle.protocol import Command, State, VehicleModel


@dataclasses.dataclass(frozen=True)
class Race(Environment[RaceParams, RaceState]):
    """The race of one drone. The fields choose code; every number is in ``RaceParams``.

    A user's functions are named by the config's keys ``observation.extra`` (fields of ``layout``),
    ``reward.terms`` (``user_terms``, with their weights) and ``rules.extra`` (``user_rules``).
    """

    model: VehicleModel
    layout: Layout  # of the observation
    integrator: str = "euler"  # "euler" | "rk4"
    randomize: bool = False  # draw new constants for every episode
    population: str | None = None  # population of the model that the constants are drawn from
    user_terms: UserFunctions = ()  # a user's reward terms, in addition to REWARDS
    user_rules: UserFunctions = ()  # a user's rules, in addition to TERMINATIONS
    report_passes: bool = False  # report the gates passed to the learner, for curricula
    # With code of a user, a new object: JAX traces and compiles it again, as it may have changed.
    code_version: object = None

    @property
    def observation_size(self) -> int:  # type: ignore[override]
        """Size of the observation."""
        return self.layout.size

    @property
    def action_size(self) -> int:  # type: ignore[override]
        """Number of scalars of a command."""
        return self.model.action_size

    @single_precision
    def reset(self, params: RaceParams, key: jax.Array) -> RaceState:
        """A random start; see ``quadjax.race.episode``."""
        return episode.reset(self, params, key)

    @single_precision
    def observe(self, params: RaceParams, state: RaceState) -> jax.Array:
        """The observation (layout.size,)."""
        return self.observation(params, state)

    @single_precision
    def step(
        self, params: RaceParams, state: RaceState, action: jax.Array
    ) -> tuple[RaceState, jax.Array, jax.Array, jax.Array]:
        """``transition`` as a step of an ``Environment``."""
        next_state, value, outcome = self.transition(params, state, action)
        return next_state, value, outcome.over, outcome.truncated

    def completed(self, before: RaceState, after: RaceState) -> jax.Array | None:
        """The number () of gates passed, 0 or 1, where it is reported."""
        if not self.report_passes:
            return None
        return (after.gates_passed - before.gates_passed).astype(jnp.float32)

    def describe_dependents(self, params: RaceParams, key: str) -> str:
        """What was computed from a number of the race; see ``quadjax.race.types``."""
        has_tracks, battery = params.tracks is not None, params.battery is not None
        return describe_dependents(key, random_tracks=has_tracks, battery=battery)

    def observation(self, params: RaceParams, state: RaceState) -> jax.Array:
        """``observe`` in any precision; see ``quadjax.race.observations``."""
        params = params.on_track(state.track)
        opaque_true = params.opaque_true
        step = Step(
            self.model, params, state, gate(params.track, state.target, opaque_true=opaque_true)
        )
        numbers = jnp.stack(_numbers(self, step, opaque_true=opaque_true))
        return numbers if params.observation_scale is None else numbers * params.observation_scale

    def command(self, params: RaceParams, action: jax.Array | tuple[jax.Array, ...]) -> Command:
        """The command of an action (action_size,): clipped to [-1, 1], scaled to its range.

        That of a policy is clipped to the range of the vehicle too.
        """
        parts = [clip_inward(action[index], -1.0, 1.0) for index in range(self.action_size)]
        low, high = command_range(self.model, params)
        unit = jax.tree.unflatten(jax.tree.structure(low), parts)
        sent = jax.tree.map(lambda u, lo, hi: lo + 0.5 * (hi - lo) * (u + 1.0), unit, low, high)
        if params.ranges is None:
            return sent
        return jax.tree.map(jnp.clip, sent, *self.model.command_range(params.vehicle.constants))

    def transition(
        self, params: RaceParams, state: RaceState, action: jax.Array
    ) -> tuple[RaceState, jax.Array, Outcome]:
        """One step with its events, in any precision.

        Returns:
            The next state, the reward () and the outcome. A state that is not finite is replaced by
            the state before it, so that no NaN propagates; the outcome reports it.
        """
        params, model = params.on_track(state.track), self.model
        opaque_true = params.opaque_true
        after = _simulate(self, params, state, action, opaque_true=opaque_true)
        g = gate(params.track, state.target, opaque_true=opaque_true)
        step = Step(model, params, state, g, after)
        outcome = _outcome(self, step, opaque_true=opaque_true)
        invalid = outcome.crashes[NOT_FINITE]
        drone = jax.tree.map(lambda new, old: jnp.where(invalid, old, new), after, state.drone)
        step = Step(model, params, state, g, drone, outcome, action)
        value = reward(step, self.user_terms)
        next_state, battery = advance_race(params, state, drone, outcome), state.battery
        if params.battery is not None and battery is not None:
            sent = self.command(params, action)
            battery = advance_battery(params.battery, battery, drone.actuators, sent)
        memories = advance_memories(self, step)
        return next_state.replace(battery=battery, memories=memories), value, outcome


# The static argument of these three is the whole race: JAX keeps the traces of equal arguments, and
# races with a user's code differ by their ``code_version``.
@materialized(static=1, gradients=True)
def _numbers(race: Race, step: Step) -> list[jax.Array]:
    return race.layout.numbers(step)


@materialized(static=1, gradients=True)
def _outcome(race: Race, step: Step) -> Outcome:
    return evaluate_rules(step, race.user_rules)


@materialized(static=1, gradients=True)
def _simulate(race: Race, params: RaceParams, state: RaceState, action: jax.Array) -> State:
    """The vehicle's state one step later; commands are clipped to its range.

    With a delay, the mean over the step of the previous and the present command acts, because the
    vehicle is slower than a step.
    """
    vehicle, model = params.vehicle_of(state), race.model
    low, high = model.command_range(vehicle.constants)
    held = jax.tree.map(clip_inward, race.command(params, action), low, high)
    if state.delay is not None:
        last = race.command(params, state.memories[LAST_ACTION])
        before = jax.tree.map(clip_inward, last, low, high)
        late = state.delay / params.rules.time_step
        held = jax.tree.map(lambda now, old: now + late * (old - now), held, before)
    if params.battery is not None and state.battery is not None:
        rpm = state.drone.actuators
        held = limit_command(params.battery, state.battery, rpm, held)
    opaque_true = params.opaque_true
    # A step of Euler's method starts from the carry of a loop, which is in memory already.
    begin = materialize_cotangent if race.integrator == "euler" else materialize
    vehicle = dataclasses.replace(vehicle, opaque_true=opaque_true)
    after = INTEGRATORS[race.integrator](
        lambda drone: model.derivative(vehicle, begin(drone, opaque_true), held),
        state.drone,
        params.rules.time_step,
    )
    return after.wrapped()


def advance_race(params: RaceParams, state: RaceState, drone: State, outcome: Outcome) -> RaceState:
    """The race one step later: vehicle state, target, clock and gates passed."""
    one = outcome.passed.astype(jnp.int32)
    next_target = state.target + one
    target = jnp.where(next_target == gate_count(params.track), 0, next_target)
    passed = state.gates_passed + one
    return state.replace(drone=drone, target=target, clock=state.clock + 1, gates_passed=passed)


def without_training_limits(model: VehicleModel, params: RaceParams) -> RaceParams:
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
        training_limits=params.training_limits.replace(**limits),
        start=params.start.replace(stagger_clocks=False),
        tracks=None,
        observation_scale=None,
    )


@dataclasses.dataclass(frozen=True)
class PrivilegedRace(Race):
    """A race whose observation ends with the drawn constants, for the critic alone.

    An asymmetric actor-critic (Pinto et al., 2017, arXiv 1710.06542): the policy's network does not
    take these numbers. ``spread`` has the names of drawn constants and the largest relative error
    of each (1 where a population has no such number); observed are relative errors, divided by it.
    """

    spread: tuple[tuple[str, float], ...] = ()

    @property
    def observation_size(self) -> int:  # type: ignore[override]
        """Size of the observation with the constants."""
        return super().observation_size + len(self.spread)

    def observe(self, params: RaceParams, state: RaceState) -> jax.Array:
        """The observation of the race and the relative errors of the constants."""
        constants, nominal = values_of(state.constants), values_of(params.vehicle.constants)
        errors = []
        for name, largest in self.spread:
            value = nominal[name]
            size = jnp.where(value == 0.0, 1.0, jnp.abs(value))
            errors.append((constants[name] - value) / (size * largest))
        return jnp.concatenate([super().observe(params, state), jnp.stack(errors)])
