"""Timed laps by the exact rules, many drones at once."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.core.gradients import Scalar
from quadjax.race import episode
from quadjax.race.environment import Race, without_training_limits
from quadjax.race.lap_times import Laps
from quadjax.race.rules import terminations_of
from quadjax.race.track import Track, gate_count
from quadjax.race.types import Outcome, RaceParams, RaceState

Actor = Callable[[Any, jax.Array, jax.Array], jax.Array]  # (policy, observation, noise)
OUT_OF_TIME = "out of time"
SLOWEST_LAP_S, SLOWEST_LAP_M = 8.0, 14.0  # longer laps have proportionally more time


class LapState(struct.PyTreeNode):
    """Drones in timed laps, batched along the last axis."""

    state: RaceState
    lap_end: jax.Array  # (laps, runs) s since the start; 0 where not completed
    over: jax.Array  # (runs,) bool
    crash_code: jax.Array  # (runs,) 0, or the number of a termination from 1


Carry = tuple[LapState, jax.Array]  # drones and the key of the next noise
Recorder = Callable[[Race, RaceParams, LapState, jax.Array], Any]


class Trace(struct.PyTreeNode):
    """Recorded states: time first, then runs."""

    position: jax.Array  # (time, 3, runs) m, world
    velocity: jax.Array  # (time, 3, runs) m/s, world
    euler: jax.Array  # (time, 3, runs) rad
    rates: jax.Array  # (time, 3, runs) rad/s
    actuators: jax.Array  # (time, actuators, runs): rpm, or thrust in m/s^2
    command: jax.Array  # (time, actions, runs)
    target: jax.Array  # (time, runs)
    over: jax.Array  # (time, runs) bool, before the step
    highest_rpm: jax.Array | None = None  # (time, runs), the estimate, where there is a battery


def starting_states(
    environment: Race,
    params: RaceParams,
    key: jax.Array,
    runs: int,
    from_hover: bool,
    around: bool = False,
) -> RaceState:
    """Starts of a race, batched along the last axis.

    Disturbances and constants are drawn as the config says, whether from hover or at random. With
    ``around``, x, y and yaw of a hover are drawn around the start of the race.
    """

    def one(key: jax.Array) -> RaceState:
        start = episode.reset(environment, params, key)
        if not from_hover:
            return start.replace(clock=jnp.zeros((), jnp.int32))
        stream = jax.random.fold_in(key, episode.AROUND_HOVER_STREAM)
        moved = episode.draw(stream, 3) if around else None
        return episode.hover_start(environment, params, start, moved)

    return jax.vmap(one, out_axes=-1)(jax.random.split(key, runs))


# One program instead of one for each of 60 operations; it rounds random starts differently.
hover_starts = jax.jit(starting_states, static_argnums=(0, 3, 4, 5))


def advance(
    environment: Race,
    params: RaceParams,
    race: LapState,
    action: jax.Array,
    last: int | None = None,
) -> LapState:
    """One step of one drone; see ``count_laps``."""
    next_state, _, outcome = environment.transition(params, race.state, action)
    gates = gate_count(params.track)
    return count_laps(race, next_state, outcome, params.rules.time_step, gates, last)


def count_laps(
    race: LapState,
    next_state: RaceState,
    outcome: Outcome,
    dt: Scalar,
    gates: int,
    last: int | None = None,
) -> LapState:
    """One drone's race after a step of ``dt`` () s: its laps, whether it is over, and why.

    A race that is over does not change. ``next_state`` is the state after the step. The race ends
    within a lap after the ``last`` gate, or with a lap of ``gates``.
    """
    passed = next_state.gates_passed
    lap, complete = (passed - 1) // gates, passed % gates == 0
    if last is not None:
        complete = complete | (passed == last)
    if outcome.finished is not None:  # a start in the middle of a course has fewer gates
        complete, lap = outcome.finished, jnp.zeros_like(lap)
    ended = (passed > race.state.gates_passed) & complete & ~race.over
    # A start in the middle of the track has its lap where its gates add up to one.
    now = jnp.asarray(next_state.clock, jnp.result_type(dt)) * dt
    lap_end = jnp.where(ended & (jnp.arange(race.lap_end.shape[0]) == lap), now, race.lap_end)
    crashed = outcome.crashed & ~race.over
    code = jnp.where(crashed, outcome.crash_code, race.crash_code)
    over = race.over | crashed | (lap_end[-1] > 0)
    state = jax.tree.map(lambda new, old: jnp.where(race.over, old, new), next_state, race.state)
    return LapState(state, lap_end, over, code)


def begin(state: RaceState, laps: int) -> LapState:
    """Drones before a race of some laps, batched along the last axis."""
    runs = state.clock.shape[-1]
    none = jnp.zeros(runs, bool), jnp.zeros(runs, jnp.int32)
    return LapState(state, jnp.zeros((laps, runs)), *none)


@functools.partial(
    jax.jit, static_argnames=("environment", "actor", "laps", "steps", "trace", "last")
)
def fly_race(
    environment: Race,
    actor: Actor,
    laps: int,
    steps: int,
    trace: bool | Recorder,
    params: RaceParams,
    policy: object,
    state: RaceState,
    key: jax.Array,
    last: int | None = None,
) -> tuple[LapState, Any]:
    """Fly from given states for at most ``steps`` steps; see ``fly_laps`` and ``begin``.

    A function as ``trace`` is called with the drones before each step, and returns what is recorded
    in place of a ``Trace``.
    """
    one = stepper(environment, actor, params, policy, last)
    carry = (begin(state, laps), key)
    if not trace:
        _, (race, _) = jax.lax.while_loop(
            lambda loop: (loop[0] < steps) & ~jnp.all(loop[1][0].over),
            lambda loop: (loop[0] + 1, one(loop[1])[0]),
            (0, carry),
        )
        return race, None

    def record(carry: Carry, _: None) -> tuple[Carry, Any]:
        after, action = one(carry)
        recorder = trace if callable(trace) else _trace
        return after, recorder(environment, params, carry[0], action)

    (race, _), recorded = jax.lax.scan(record, carry, None, steps)
    return race, recorded


def stepper(
    environment: Race, actor: Actor, params: RaceParams, policy: object, last: int | None = None
) -> Callable[[Carry], tuple[Carry, jax.Array]]:
    """One step of all drones: to the race after it, and the actions (runs, actions)."""
    observe = jax.vmap(environment.observation, in_axes=(None, -1))
    act = jax.vmap(actor, in_axes=(None, 0, 0))
    step = jax.vmap(
        lambda race, action: advance(environment, params, race, action, last),
        in_axes=(-1, 0),
        out_axes=-1,
    )

    def one(carry: Carry) -> tuple[Carry, jax.Array]:
        race, key = carry
        key, noise_key = jax.random.split(key)
        noise = jax.random.normal(noise_key, (race.over.shape[-1], environment.model.action_size))
        action = act(policy, observe(params, race.state), noise)
        return (step(race, action), key), action

    return one


def _trace(environment: Race, params: RaceParams, race: LapState, action: jax.Array) -> Trace:
    drone, battery = race.state.drone, race.state.battery
    command = jax.vmap(functools.partial(environment.command, params), out_axes=-1)
    signals = drone.position, drone.velocity, drone.euler, drone.rates, drone.actuators
    rows = (jnp.stack(jax.tree.leaves(signal)) for signal in (*signals, command(action)))
    position, velocity, euler, rates, actuators, sent = rows
    highest = None if battery is None else battery.estimate.highest
    motion = position, velocity, euler, rates
    return Trace(*motion, actuators, sent, race.state.target, race.over, highest)


def fly_laps(
    environment: Race,
    params: RaceParams,
    actor: Actor,
    policy: object,
    key: jax.Array,
    laps: int = 6,
    runs: int = 5,
    from_hover: bool = True,
    trace: bool = False,
    gates: int | None = None,
) -> tuple[Laps, Trace | None]:
    """Fly a timed race by the exact rules, without gate inflation and training limits.

    The static ``actor(policy, observation (k,), noise (a,)) -> action (a,)`` is of one drone, with
    ``a`` the vehicle model's ``action_size``; ``policy`` is a pytree. Starts are hover at the last
    gate, or the training's random ones. A number of ``gates`` takes the place of ``laps``; the last
    lap may then be a part of one.

    Returns:
        The result, and the recorded states and commands if ``trace`` is true.
    """
    length, last = race_length(params.track, laps, gates), last_gate(params.track, gates)
    params = without_training_limits(environment.model, params)
    start_key, noise_key = jax.random.split(key)
    start = hover_starts if from_hover else starting_states
    states = start(environment, params, start_key, runs, from_hover)
    sizes = math.ceil(length), step_limit(params, length), trace
    race, recorded = fly_race(environment, actor, *sizes, params, policy, states, noise_key, last)
    result = laps_of(
        environment, race, float(params.rules.time_step), time_limit(params.track, length)
    )
    return dataclasses.replace(result, last_gates=(gates or 0) % gate_count(params.track)), recorded


def race_length(track: Track, laps: int, gates: int | None = None) -> float:
    """The length of a race in laps: ``laps``, or that of a number of gates.

    Raises:
        InputError: ``gates`` of a course, which ends with its last gate.
    """
    if gates is None:
        return laps
    if not track.closed:
        raise InputError(f"gates is {gates}, allowed: null on a course (track.closed false)")
    return gates / gate_count(track)


def last_gate(track: Track, gates: int | None) -> int | None:
    """The number of gates after which a race ends within a lap; None: at the end of a lap."""
    return gates if gates is not None and gates % gate_count(track) else None


def time_limit(track: Track, laps: float) -> float:
    """The time limit of a race of some laps, s."""
    return laps * SLOWEST_LAP_S * max(1.0, lap_length(track) / SLOWEST_LAP_M)


def step_limit(params: RaceParams, laps: float) -> int:
    """The time limit of a race, steps."""
    return round(time_limit(params.track, laps) / float(params.rules.time_step))


def laps_of(environment: Race, race: LapState, dt: float, limit: float) -> Laps:
    """The result of a race that is over, ``dt`` s a step, with its time limit in s."""
    ends = np.asarray(race.lap_end, np.float64).T
    completed = np.where(ends > 0, ends, np.nan)
    times = np.diff(completed, axis=1, prepend=0.0)
    reasons = ("", *terminations_of(environment.user_rules))
    crashes = [reasons[code] for code in np.asarray(race.crash_code)]
    for run in np.flatnonzero(~np.isfinite(completed[:, -1])):
        crashes[run] = crashes[run] or OUT_OF_TIME
    seconds = np.asarray(race.state.clock, np.float64) * dt
    return Laps(times, tuple(crashes), seconds, limit)


def lap_length(track: Track) -> float:
    """Length of a lap along straight lines from gate to gate, or of a course from its start, m."""
    centers = np.stack([np.asarray(x, np.float64) for x in track.position.components()], axis=-1)
    before = np.roll(centers, 1, axis=0)
    if not track.closed and track.start is not None:
        before[0] = [float(x) for x in track.start.position.components()]
    return float(np.linalg.norm(centers - before, axis=1).sum())
