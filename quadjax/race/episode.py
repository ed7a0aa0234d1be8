"""How an episode begins: at random around the track, or as a timed race does."""

import functools
import math
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.frames import wrap_angle
from quadjax.core.gradients import Scalar
from quadjax.core.vectors import Vec3, from_unit, safe_norm
from quadjax.race.memory import begin_memories
from quadjax.race.track import (
    Gate,
    Track,
    gate,
    gate_count,
    pick,
    through_opening,
    to_opening_frame,
)
from quadjax.race.types import RaceParams, RaceState
from quadjax.vehicle.battery import BatteryState, battery_at_start, draw_battery
from quadjax.vehicle.protocol import Constants, Motion, State, VehicleModel

if TYPE_CHECKING:
    from quadjax.race.environment import Race

# Streams of random numbers, folded into the key of a start; another number changes the draws. The
# ``Draws`` of a start are of the key itself.
ALONG_LEG_STREAM, BATTERY_STREAM, TRACK_STREAM = 1, 2, 3
RACE_START_STREAM, AROUND_HOVER_STREAM, DELAY_STREAM = 5, 6, 7
AROUND_START_M, AROUND_START_RAD = 0.5, math.pi / 4.0  # half-widths of x and y, and of the yaw


Draws = dict[str, jax.Array]  # random numbers of one start, each in [-1, 1]; see ``draw_start``


def draw(key: jax.Array, count: int) -> jax.Array:
    """Uniform numbers in [-1, 1], (count,); one call for all, which compiles much faster."""
    return jax.random.uniform(key, (count,), minval=-1.0, maxval=1.0)


def draw_start(model: VehicleModel, key: jax.Array, constants: int = 0) -> Draws:
    """The random numbers of a start, with those of a number of constants."""
    sizes = {"gate": 1, "clock": 1, "position": 3, "velocity": 3, "euler": 3, "rates": 3}
    # Four for fewer actuators too: all other numbers of a key are then those of any such model.
    sizes |= {"actuators": max(4, model.actuators.size), "disturbance": 4, "constants": constants}
    ends = np.cumsum(list(sizes.values()))
    return dict(zip(sizes, jnp.split(draw(key, int(ends[-1])), ends[:-1]), strict=True))


def reset(environment: "Race", params: RaceParams, key: jax.Array) -> RaceState:
    """A random start, on one of the random tracks where there are any, each with the same chance.

    Raises:
        InputError: ``params`` has both random tracks and headings. Headings are defined for
            ``params.track`` only.
    """
    track, ranges = None, params.start
    if params.tracks is not None:
        if params.heading is not None:
            raise InputError("params.heading is set, allowed: None with params.tracks")
        count = params.tracks.yaw.shape[0]
        index = jax.random.randint(jax.random.fold_in(key, TRACK_STREAM), (), 0, count)
        track = jax.tree.map(lambda numbers: numbers[index], params.tracks)
        params = params.on_track(track)
    size = len(jax.tree.leaves(params.vehicle.constants)) if environment.randomize else 0
    draws = draw_start(environment.model, key, size)
    constants = _draw_constants(environment, params, draws["constants"])
    of_drone = params.vehicle.constants if constants is None else constants
    drone, target = _draw_drone(environment.model, params, of_drone, draws, key)
    battery, clock = None, jnp.zeros((), jnp.int32)
    if params.battery is not None:
        battery = draw_battery(
            params.battery, drone.actuators, jax.random.fold_in(key, BATTERY_STREAM)
        )
    if ranges.stagger_clocks:
        steps = jnp.asarray(params.training_limits.episode_steps, draws["clock"].dtype)
        clock = (0.5 * (draws["clock"][0] + 1.0) * steps).astype(jnp.int32)
    state = _begin(environment, params, drone, target, constants, battery)
    if params.delay is not None:
        late = jax.random.uniform(jax.random.fold_in(key, DELAY_STREAM), minval=-1.0)
        state = state.replace(delay=from_unit(*params.delay, late))
    if ranges.race is not None:
        race_key, used_key = jax.random.split(jax.random.fold_in(key, RACE_START_STREAM))
        race = hover_start(environment, params, state, draw(race_key, 3))
        used = functools.partial(jnp.where, jax.random.uniform(used_key) < ranges.race)
        state = jax.tree.map(used, race, state)
    return state.replace(clock=clock, track=track)


def _draw_constants(
    environment: "Race", params: RaceParams, numbers: jax.Array
) -> Constants | None:
    """The constants of one episode, of numbers (n,) in [-1, 1]; None: those of ``params``.

    Those of a population are between the nominal ones (width 0) and those of a drone (width 1).
    """
    constants, population = params.vehicle.constants, environment.population
    if params.mismatch is not None:
        constants = jax.tree.map(jnp.multiply, constants, params.mismatch)
    if not environment.randomize:
        return None if params.mismatch is None else constants
    if population is None:
        spread = params.randomization.by_constant(environment.model, jnp.maximum)
        return draw_constants(constants, environment.model.make_constants(spread), numbers)
    width, drone = params.randomization.width, environment.model.populations[population]
    return jax.tree.map(lambda x, y: x + width * (y - x), constants, drone(constants, numbers))


def draw_constants(nominal: Constants, spread: Constants, numbers: jax.Array) -> Constants:
    """Constants of one episode: each scaled by its own draw from 1 +- its fraction in ``spread``.

    ``numbers`` holds one number in [-1, 1] for each constant.
    """
    count = len(jax.tree.leaves(nominal))
    factors = jax.tree.unflatten(jax.tree.structure(nominal), [numbers[i] for i in range(count)])
    return jax.tree.map(lambda x, width, draw: x * (1.0 + width * draw), nominal, spread, factors)


def _draw_drone(
    model: VehicleModel, params: RaceParams, of_drone: Constants, draws: Draws, key: jax.Array
) -> tuple[State, jax.Array]:
    """The vehicle's state at a random start with its disturbances, and the gate to pass next.

    The start is around a point of the way to this gate.
    """
    starts, target, along = params.start, jnp.zeros((), jnp.int32), jnp.zeros(())
    if starts.gate == "random":
        target = start_gate(params.track, draws["gate"][0])
    if starts.along_leg is not None:
        along = starts.along_leg * jax.random.uniform(jax.random.fold_in(key, ALONG_LEG_STREAM))
    motion = _motion(params, target, along, draws)
    low, high = map(jnp.asarray, starts.thrust)
    state = model.start(of_drone, motion, draws["actuators"], (low, high))
    if not model.disturbed:
        return state, target
    ranges = params.disturbance
    widths = _vector(ranges.moment_x, ranges.moment_y, ranges.moment_z)
    moment = Vec3.of(draws["disturbance"][:3]) * widths + _vector(*ranges.moment_bias)
    force = Vec3.zero().replace(z=draws["disturbance"][3] * ranges.force_z)
    return state.replace(moment_ext=moment, force_ext=force), target


def _vector(x: Scalar, y: Scalar, z: Scalar) -> Vec3:
    """A vector of the numbers of a section."""
    return Vec3(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))


def start_gate(track: Track, number: jax.Array) -> jax.Array:
    """Index () of a gate, any with equal chance, of a number drawn from [-1, 1]."""
    count = gate_count(track)
    return jnp.minimum((0.5 * (number + 1.0) * count).astype(jnp.int32), count - 1)


def _motion(params: RaceParams, target: jax.Array, fraction: jax.Array, draws: Draws) -> Motion:
    """The motion of a start around the point at a ``fraction`` () of the way to a target gate."""
    ranges = params.start
    roll_pitch, yaw = jnp.radians(ranges.roll_pitch_deg), jnp.radians(ranges.yaw_deg)
    euler = Vec3.of(draws["euler"]) * _vector(roll_pitch, roll_pitch, yaw)
    if params.heading is not None:
        euler = euler.replace(z=wrap_angle(euler.z + pick(params.heading, target)))
    way = _way(params.track, target, fraction)
    position = way + Vec3.of(draws["position"]) * ranges.position
    if ranges.along_leg is not None:
        position = _before_gate(gate(params.track, target), way, position)
    return Motion(
        position,
        Vec3.of(draws["velocity"]) * ranges.velocity,
        euler,
        Vec3.of(draws["rates"]) * ranges.body_rates,
    )


def _before_gate(g: Gate, way: Vec3, position: Vec3) -> Vec3:
    """The position, mirrored in the plane of the target gate if its offset from the way crosses it.

    Both are in m, world.
    """
    of_way, of_start = (to_opening_frame(g, x - g.position).x for x in (way, position))
    depth = jnp.where((of_way < 0.0) & (of_start > 0.0), of_start, 0.0)
    return position - through_opening(g) * (2.0 * depth)


def _way(track: Track, target: jax.Array, fraction: jax.Array) -> Vec3:
    """The point, m, at a ``fraction`` () of the way from the gate before to the target gate.

    The way is a cubic Hermite curve with the horizontal headings of both gates and the length of
    the leg as the length of its tangents. Its height lies between those of the gates. The curve
    from the start of a course has no tangent there.
    """
    count, zero = gate_count(track), jnp.zeros_like(fraction)
    before, after = gate(track, (target + count - 1) % count), gate(track, target)
    begin, heading = before.position, Vec3(before.cos_yaw, before.sin_yaw, zero)
    if not track.closed and track.start is not None:
        first = functools.partial(jnp.where, target == 0)
        begin = jax.tree.map(first, track.start.position, begin)
        heading = jax.tree.map(first, Vec3.zero(), heading)
    leg = after.position - begin
    length, left = safe_norm(leg), 1.0 - fraction
    leave, enter = length * fraction * left**2, -length * fraction**2 * left
    arrival = Vec3(after.cos_yaw, after.sin_yaw, zero)
    return begin + leg * (fraction**2 * (3.0 - 2.0 * fraction)) + heading * leave + arrival * enter


def hover(model: VehicleModel, c: Constants, track: Track, moved: jax.Array | None = None) -> State:
    """At rest and level at the track's start, or at the last gate, facing the first one.

    On the ground the actuators are at their lowest, elsewhere those of a hover. ``moved`` (3,) in
    [-1, 1] moves x, y and the yaw by ``AROUND_START_M`` and ``AROUND_START_RAD``, as the ground
    starts of MonoRace (arXiv 2601.15222); None: exactly there.
    """
    if track.start is not None:
        position, yaw = track.start.position, track.start.yaw
    else:
        first, position = (jax.tree.map(lambda x, i=i: x[i], track.position) for i in (0, -1))
        yaw = jnp.arctan2(first.y - position.y, first.x - position.x)
    if moved is not None:
        aside = Vec3(moved[0], moved[1], jnp.zeros_like(moved[2])) * AROUND_START_M
        position, yaw = position + aside, yaw + AROUND_START_RAD * moved[2]
    motion = Motion(position, Vec3.zero(), Vec3.zero().replace(z=wrap_angle(yaw)), Vec3.zero())
    if track.start is None or not track.start.on_ground:
        return model.hover(c, motion)
    lowest = -jnp.ones(max(4, model.actuators.size))
    return model.start(c, motion, lowest, (jnp.zeros(()), jnp.zeros(())))


def hover_start(
    environment: "Race",
    params: RaceParams,
    start: RaceState | None = None,
    moved: jax.Array | None = None,
) -> RaceState:
    """The start of a timed race: hover at the track's start, or the last gate; see ``hover``.

    The constants, disturbances, battery and delay are those of ``start``; without one nothing is
    drawn, the battery has the highest charge, and the delay is the middle of its range.
    """
    model, constants = environment.model, None if start is None else start.constants
    drone = hover(model, constants or params.vehicle.constants, params.track, moved)
    if start is not None and model.disturbed:
        moment, force = start.drone.disturbance
        drone = drone.replace(moment_ext=moment, force_ext=force)
    battery = None
    if params.battery is not None:
        charged = None if start is None else start.battery
        battery = battery_at_start(params.battery, drone.actuators, charged)
    state = _begin(environment, params, drone, jnp.zeros((), jnp.int32), constants, battery)
    return state if start is None else state.replace(delay=start.delay)


def _begin(
    environment: "Race",
    params: RaceParams,
    drone: State,
    target: jax.Array,
    constants: Constants | None,
    battery: BatteryState | None,
) -> RaceState:
    zero = jnp.zeros((), jnp.int32)
    state = RaceState(drone, target, zero, zero, constants, battery=battery)
    if params.delay is not None:
        state = state.replace(delay=from_unit(*params.delay, jnp.zeros(())))
    return begin_memories(environment, params, state)
