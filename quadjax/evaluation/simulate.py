"""Flights of a policy in the simulator, from any start, on one track or on several."""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp

from quadjax.config.assembly import make_race
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.evaluation.conditions import Condition, Conditions, damaged
from quadjax.evaluation.published import LAPS, published_row
from quadjax.evaluation.rows import Row, speed_record, speeds_of
from quadjax.flights.flight import Flight, recorded_flights
from quadjax.policy import pilot
from quadjax.policy.file import Policy
from quadjax.race import episode
from quadjax.race import laps as race
from quadjax.race.environment import Race, without_training_limits
from quadjax.race.episode import draw_start, start_gate
from quadjax.race.laps import Actor
from quadjax.race.memory import begin_memories
from quadjax.race.random_track import RandomTracks
from quadjax.race.track import Track, gate, gate_count
from quadjax.race.types import RaceParams, RaceState
from quadjax.vehicle.protocol import Motion

BEFORE_GATE_M = 1.0
HALF_VELOCITY_M_S, HALF_ROLL_PITCH_RAD, HALF_RATES_RAD_S = 0.5, math.pi / 9, 0.1  # half-widths
PUBLISHED_PROTOCOL = (LAPS, "hover", False)  # protocol of the published flights
MAX_LAPS = 64  # that one flight of a given duration is counted for
RECORDED_STATES = 100_000  # of all runs together: with more, states are not kept


def simulate(
    policy: Policy,
    name: str,
    configs: tuple[Config, Config],
    condition: Condition,
    protocol: Conditions,
    actor: Actor = pilot.act,
) -> Row:
    """Simulate the flights of a policy under a condition.

    Args:
        policy: the policy.
        name: of its file, for messages.
        configs: the race as modeled, whose vehicle is the onboard estimator's; and the race.
        condition: with the damage of the drone.
        protocol: start, number, length and seed of the flights.
        actor: computes the actions.

    Returns:
        The row, with that of the published flights of the same race and protocol, if any. Its
        record simulates the flights again if they have more than ``RECORDED_STATES`` states.

    Raises:
        InputError: a policy that does not fit the race, or a start that random tracks lack.
    """
    modeled, config = configs
    label = condition.label
    if protocol.tracks:
        if protocol.start != "hover":
            raise InputError(f"start is {protocol.start}, allowed: hover on random tracks")
        tracks = unseen_tracks(modeled, protocol.runs or 1)
        label = f"{tracks.seed} to {tracks.seed + tracks.count - 1}"
        config = config.replace(randomization=config.randomization.replace(tracks=tracks))
    environment, params = pilot.adapt_race(*make_race(config), policy, name)
    layouts = params.tracks if protocol.tracks else None
    ready = pilot.make_pilot(policy, bool(protocol.deterministic))
    params = without_training_limits(environment.model, params)
    if condition.damage is not None:
        environment = dataclasses.replace(
            environment, model=damaged(environment.model, condition.damage)
        )
    if protocol.drawn:
        environment = dataclasses.replace(environment, randomize=True)
    if params.estimator is not None and config.vehicle != modeled.vehicle:
        onboard = make_race(modeled.replace(observation=config.observation))[1]
        params = params.replace(estimator=onboard.estimator)
    if layouts is not None:
        params = params.replace(track=_longest(layouts))
    length = race.race_length(params.track, protocol.laps or 1, protocol.gates)
    limit, count = protocol.seconds, MAX_LAPS
    if limit is None:
        limit, count = race.time_limit(params.track, length), math.ceil(length)
    time_step = float(params.rules.time_step)
    steps, last = round(limit / time_step), race.last_gate(params.track, protocol.gates)
    key, noise = jax.random.split(jax.random.key(protocol.seed))
    states, speeds = _starts(environment, params, key, layouts, protocol), None
    flights = (params, ready, states, noise, last)
    few = states.clock.shape[-1] * steps <= RECORDED_STATES
    trace = speed_record if protocol.speeds else few
    flown, recorded = race.fly_race(environment, actor, count, steps, trace, *flights)
    laps = race.laps_of(environment, flown, time_step, limit)
    gates = (protocol.gates or 0) % gate_count(params.track)
    laps = dataclasses.replace(laps, last_gates=gates)
    if protocol.speeds:
        speeds = speeds_of(recorded, laps, time_step, config.vehicle.fitted_speed or math.inf)

    def record() -> list[Flight]:
        kept = recorded
        if trace is not True:
            _, kept = race.fly_race(environment, actor, count, steps, True, *flights)
        runs = recorded_flights(kept, laps, time_step, config.track.gates, environment.model)
        return [run.of_drone(config.vehicle.constants) for run in runs]

    is_alike = (protocol.laps, protocol.start, protocol.deterministic) == PUBLISHED_PROTOCOL
    is_alike = is_alike and condition.damage is None and not protocol.tracks
    published = published_row(config) if is_alike else None
    limit, best = config.vehicle.fitted_speed, config.evaluate.best_known_lap
    return Row(name, laps, label, 1, speeds, limit, record, published, best)


def _starts(
    environment: Race,
    params: RaceParams,
    key: jax.Array,
    tracks: Track | None,
    protocol: Conditions,
) -> RaceState:
    runs, start = protocol.runs or 1, protocol.start
    if tracks is not None:

        def hover_on(track: Track) -> RaceState:
            return episode.hover_start(environment, params.on_track(track)).replace(track=track)

        return jax.vmap(hover_on, out_axes=-1)(tracks)
    if start == "before_gate":
        return starts_before_gate(environment, params, jax.random.split(key, runs))
    if start == "random":  # a compiled program rounds random starts differently
        return race.starting_states(environment, params, key, runs, from_hover=False)
    return race.hover_starts(environment, params, key, runs, True, start == "around")


def _longest(tracks: Track) -> Track:
    """The longest of several tracks, which are batched along the first axis."""
    count = jax.tree.leaves(tracks)[0].shape[0]
    separate = [jax.tree.map(lambda x, i=i: x[i], tracks) for i in range(count)]
    return max(separate, key=race.lap_length)


def unseen_tracks(config: Config, count: int) -> RandomTracks:
    """Random tracks with the seeds after those of the training (``randomization.tracks``)."""
    training_tracks = config.randomization.tracks or RandomTracks()
    return training_tracks.replace(seed=training_tracks.seed + training_tracks.count, count=count)


def start_before_gate(environment: Race, params: RaceParams, key: jax.Array) -> RaceState:
    """A start ``BEFORE_GATE_M`` before a gate, on the line through it; constants are drawn.

    The reset of Ferede et al., "One Net to Rule Them All" (arXiv 2504.21586).
    """
    first, second = jax.random.split(key)
    state, model = episode.reset(environment, params, first), environment.model
    draws = draw_start(model, second)
    target = start_gate(params.track, draws["gate"][0])
    g = gate(params.track, target)
    behind = Vec3(g.cos_yaw, g.sin_yaw, jnp.zeros_like(g.yaw)) * BEFORE_GATE_M
    motion = Motion(
        position=g.position - behind,
        velocity=Vec3.of(draws["velocity"]) * HALF_VELOCITY_M_S,
        euler=Vec3.of(draws["euler"])
        * Vec3(*map(jnp.float32, (HALF_ROLL_PITCH_RAD, HALF_ROLL_PITCH_RAD, math.pi))),
        rates=Vec3.of(draws["rates"]) * HALF_RATES_RAD_S,
    )
    low, high = map(jnp.asarray, params.start.thrust)
    constants = params.vehicle.constants if state.constants is None else state.constants
    drone = model.start(constants, motion, draws["actuators"], (low, high))
    zero = jnp.zeros((), jnp.int32)
    begun = state.replace(drone=drone, target=target, clock=zero, gates_passed=zero)
    return begin_memories(environment, params, begun)


@functools.partial(jax.jit, static_argnums=0)
def starts_before_gate(environment: Race, params: RaceParams, keys: jax.Array) -> RaceState:
    """``start_before_gate`` for each key (n,), batched along the last axis."""
    return jax.vmap(functools.partial(start_before_gate, environment), (None, 0), -1)(params, keys)
