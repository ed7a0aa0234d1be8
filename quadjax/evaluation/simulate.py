"""Flights of a policy in a race, from any start, on one track or on several."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.vectors import Vec3, safe_norm
from quadjax.evaluation.protocol import Protocol
from quadjax.evaluation.rows import Speeds
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.policy.pilot import Pilot
from quadjax.race import environment, episode, laps
from quadjax.race.environment import Choices, RaceParams, RaceState
from quadjax.race.episode import draw_start, start_gate, with_memory
from quadjax.race.laps import Actor, Laps, LapState, Trace
from quadjax.race.track import Track, gate, gate_count
from quadjax.vehicle.protocol import Motion

DISTANCE = 1.0  # m before the gate
VELOCITY, ROLL_PITCH, RATES = 0.5, math.pi / 9, 0.1  # half-widths: m/s, rad, rad/s
MAX_LAPS = 64  # that one flight of a given duration is counted for


@dataclasses.dataclass(frozen=True)
class Flights:
    """Flights before they are simulated.

    Attributes:
        choices: of the race, with the observation of the policy.
        params: of the race, by the exact rules.
        policy: with the scaling of the race.
        protocol: start, number, length and seed.
        tracks: of the protocol.
        actor: computes the actions.
    """

    choices: Choices
    params: RaceParams
    policy: Pilot
    protocol: Protocol
    tracks: Track | None = None
    actor: Actor = pilot.fly

    @property
    def time_step(self) -> float:
        """Of the simulation, s."""
        return float(self.params.rules.time_step)

    @property
    def length(self) -> float:
        """Of a flight, laps."""
        return laps.race_length(self.params.track, self.protocol.laps, self.protocol.gates)

    @property
    def count(self) -> int:
        """Number of laps that are counted, the last of which may be a part of one."""
        return math.ceil(self.length) if self.protocol.seconds is None else MAX_LAPS

    @property
    def limit(self) -> float:
        """Longest duration of a flight, s."""
        seconds = self.protocol.seconds
        return laps.time_limit(self.params.track, self.length) if seconds is None else seconds

    @property
    def last(self) -> int | None:
        """Number of gates after which a flight ends within a lap."""
        return laps.last_gate(self.params.track, self.protocol.gates)

    def states(self, key: jax.Array) -> RaceState:
        """Starts, batched along the last axis.

        At hover before the first gate of the race ("hover"; on each of ``tracks``), at hover around
        that place ("around"), at the random starts of training ("random"), or 1 m before a random
        gate ("before_gate").
        """
        choices, params, runs = self.choices, self.params, self.protocol.runs
        if self.tracks is not None:
            hover = functools.partial(hover_on, choices, params)
            return jax.vmap(hover, out_axes=-1)(self.tracks)
        if self.protocol.start == "before_gate":
            begin = jax.jit(starts_before_gate, static_argnums=(0, 3))
            return begin(choices, params, key, runs)
        if self.protocol.start == "around":
            begin = jax.jit(laps.starting_states, static_argnums=(0, 3, 4, 5))
            return begin(choices, params, key, runs, True, True)
        return laps.starting_states(choices, params, key, runs, self.protocol.start == "hover")

    def fly(self, trace: bool = False) -> tuple[Laps, Trace | None]:
        """Simulate; with ``trace`` the states are recorded."""
        key, noise = jax.random.split(jax.random.key(self.protocol.seed))
        steps = round(self.limit / self.time_step)
        settings = (self.choices, self.actor, self.count, steps, trace, self.params, self.policy)
        race, kept = laps.fly_race(*settings, self.states(key), noise, self.last)
        return self._laps(race), kept

    def fly_with_speeds(self, limit: float | None) -> tuple[Laps, Speeds]:
        """Simulate, with the time above a speed ``limit``, m/s."""
        key, noise = jax.random.split(jax.random.key(self.protocol.seed))
        drones = laps.begin(self.states(key), self.count), noise
        settings = (self.choices, self.actor, round(self.limit / self.time_step), self.last)
        numbers = (self.params, self.policy, drones, math.inf if limit is None else limit)
        race, speeds = fly_with_speeds(*settings, *numbers)
        return self._laps(race), Speeds(*(np.asarray(x, np.float64) for x in speeds))

    def _laps(self, race: LapState) -> Laps:
        result = laps.laps_of(self.choices, race, self.time_step, self.limit)
        gates = (self.protocol.gates or 0) % gate_count(self.params.track)
        return dataclasses.replace(result, last_gates=gates)


def longest(tracks: Track) -> Track:
    """The longest of several tracks, which are batched along the first axis."""
    count = jax.tree.leaves(tracks)[0].shape[0]
    each = [jax.tree.map(lambda x, i=i: x[i], tracks) for i in range(count)]
    return max(each, key=laps.lap_length)


def hover_on(choices: Choices, params: RaceParams, track: Track) -> RaceState:
    """Hover at the last gate of a track."""
    return episode.hover_start(choices, params.on_track(track)).replace(track=track)


def starts_before_gate(
    choices: Choices, params: RaceParams, key: jax.Array, runs: int
) -> RaceState:
    """Starts before the gates, batched along the last axis."""
    one = functools.partial(start_before_gate, choices, params)
    return jax.vmap(one, out_axes=-1)(jax.random.split(key, runs))


def start_before_gate(choices: Choices, params: RaceParams, key: jax.Array) -> RaceState:
    """A start ``DISTANCE`` before a gate, on the line through it; constants are drawn.

    The reset of Ferede et al., "One Net to Rule Them All" (arXiv 2504.21586).
    """
    first, second = jax.random.split(key)
    state, model = environment.reset(choices, params, first), choices.model
    drawn = draw_start(model, second)
    target = start_gate(params.track, drawn["gate"][0])
    g = gate(params.track, target)
    behind = Vec3(g.cos_yaw, g.sin_yaw, jnp.zeros_like(g.yaw)) * DISTANCE
    motion = Motion(
        position=g.position - behind,
        velocity=Vec3.of(drawn["velocity"]) * VELOCITY,
        euler=Vec3.of(drawn["euler"]) * Vec3(*map(jnp.float32, (ROLL_PITCH, ROLL_PITCH, math.pi))),
        rates=Vec3.of(drawn["rates"]) * RATES,
    )
    low, high = map(jnp.asarray, params.start.thrust)
    constants = params.vehicle.constants if state.constants is None else state.constants
    drone = model.start(constants, motion, drawn["actuators"], (low, high))
    zero = jnp.zeros((), jnp.int32)
    fresh = state.replace(drone=drone, target=target, step=zero, gates_passed=zero)
    return with_memory(choices, params, fresh)


@functools.partial(jax.jit, static_argnums=(0, 1, 2, 3))
def fly_with_speeds(
    choices: Choices,
    actor: Actor,
    steps: int,
    last: int | None,
    params: RaceParams,
    policy: object,
    drones: laps.Carry,
    limit: float,
) -> tuple[LapState, tuple[jax.Array, jax.Array, jax.Array]]:
    """Fly given drones for at most ``steps`` steps.

    Returns:
        The race, and (runs,) each the time until the first gate (0 before), s, the highest speed,
        m/s, and the time above ``limit``, m/s, in s.
    """
    one, dt = laps.stepper(choices, actor, params, policy, last), params.rules.time_step

    def going_on(carry: tuple) -> jax.Array:
        return (carry[0] < steps) & ~jnp.all(carry[1][0].over)

    def step(carry: tuple) -> tuple:
        count, (before, key), (first, highest, above) = carry
        (race, key), _ = one((before, key))
        passed = (first == 0.0) & (race.state.gates_passed > 0)
        now = safe_norm(race.state.drone.velocity)
        clock = jnp.asarray(race.state.step, jnp.result_type(dt)) * dt
        first = jnp.where(passed, clock, first)
        fast = (now > limit) & ~before.over
        return count + 1, (race, key), (first, jnp.maximum(highest, now), above + dt * fast)

    none = jnp.zeros(drones[0].over.shape)
    _, (race, _), speeds = jax.lax.while_loop(going_on, step, (0, drones, (none, none, none)))
    return race, speeds


def prepare(
    race: tuple[Choices, RaceParams], policy: Policy, name: str, deterministic: bool
) -> tuple[Choices, RaceParams, Pilot]:
    """A race by the exact rules with the observation of a policy, and the policy in it.

    Raises:
        InputError: the policy does not fit the race.
    """
    choices, params = pilot.fit_race(*race, policy, name)
    own = pilot.make_pilot(choices, params, policy, deterministic)
    return choices, environment.exact_rules(choices.model, params), own
