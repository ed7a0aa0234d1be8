"""Starts of episodes: states, disturbances and constants."""

import functools
import math

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.frames import wrap_angle
from quadjax.core.vectors import Vec3, safe_norm
from quadjax.race.recorded_starts import RecordedStart, RecordedStarts
from quadjax.race.track import Track, gate, gate_count, pick
from quadjax.vehicle.protocol import Constants, Motion, State, VehicleModel


@struct.dataclass
class StartRange:
    """Half-widths of the uniform start distribution, and the range of the actuators' state."""

    position: jax.Array  # m
    velocity: jax.Array  # m/s
    roll_pitch: jax.Array  # rad
    yaw: jax.Array  # rad
    rates: jax.Array  # rad/s
    thrust_low: jax.Array  # m/s^2, rate-level vehicle
    thrust_high: jax.Array
    # (gates,) rad, center of the drawn yaw by target gate; None: north.
    heading: jax.Array | None = None
    # () farthest start on the way to the target gate, a part of it; None: at the gate before.
    along_leg: jax.Array | None = None
    recorded: RecordedStarts | None = None  # states in which a part of the episodes starts
    race: jax.Array | None = None  # () part of the episodes that begin as a race does


@struct.dataclass
class DisturbanceRange:
    """Half-widths of the external disturbances that are drawn at reset, or observed."""

    moment_x: jax.Array  # N m
    moment_y: jax.Array
    moment_z: jax.Array
    force_z: jax.Array  # m/s^2
    moment_bias: Vec3  # N m, added to what is drawn


DISTURBANCE_DRAWS = 4


def draw_count(model: VehicleModel) -> int:
    """The number of random numbers of a start: motion, actuators (at least 4), disturbances."""
    return 12 + max(4, model.actuators.size) + DISTURBANCE_DRAWS


def draw(key: jax.Array, count: int) -> jax.Array:
    """Uniform numbers in [-1, 1], (count,); one call for all, which compiles much faster."""
    return jax.random.uniform(key, (count,), minval=-1.0, maxval=1.0)


def start_gate(track: Track, drawn: jax.Array) -> jax.Array:
    """Index () of a gate, any with equal chance, of a number drawn from [-1, 1]."""
    count = gate_count(track)
    return jnp.minimum((0.5 * (drawn + 1.0) * count).astype(jnp.int32), count - 1)


def _way(track: Track, target: jax.Array, part: jax.Array) -> Vec3:
    """The point, m, at a ``part`` () of the way from the gate before to the target gate.

    The way is a cubic Hermite curve with the horizontal headings of both gates and the length of
    the leg as the length of its tangents. Its height lies between those of the gates. The curve
    from the start of a course has no tangent there.
    """
    count = gate_count(track)
    before, after = gate(track, (target + count - 1) % count), gate(track, target)
    begin, heading = before.position, Vec3(before.cos_yaw, before.sin_yaw, jnp.zeros_like(part))
    if not track.closed and track.start is not None:
        first = functools.partial(jnp.where, target == 0)
        begin = jax.tree.map(first, track.start.position, begin)
        heading = jax.tree.map(first, Vec3.zero(), heading)
    leg = after.position - begin
    length, left = safe_norm(leg), 1.0 - part
    leave, enter = length * part * left**2, -length * part**2 * left
    arrival = Vec3(after.cos_yaw, after.sin_yaw, jnp.zeros_like(part))
    return begin + leg * (part**2 * (3.0 - 2.0 * part)) + heading * leave + arrival * enter


def _pose(
    track: Track, span: StartRange, target: jax.Array, drawn: jax.Array, part: jax.Array | None
) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Position, velocity, Euler angles and body rates around a point of the way to the target."""
    position = _way(track, target, jnp.zeros(()) if part is None else part)
    angle = Vec3(span.roll_pitch, span.roll_pitch, span.yaw)
    euler = Vec3.of(drawn[6:9]) * angle
    if span.heading is not None:
        euler = euler.replace(z=wrap_angle(euler.z + pick(span.heading, target)))
    return (
        position + Vec3.of(drawn[0:3]) * span.position,
        Vec3.of(drawn[3:6]) * span.velocity,
        euler,
        Vec3.of(drawn[9:12]) * span.rates,
    )


def _heading(begin: Vec3, end: Vec3) -> jax.Array:
    """The heading (), rad, from one point to another."""
    return jnp.arctan2(end.y - begin.y, end.x - begin.x)


def start(
    model: VehicleModel,
    c: Constants,
    track: Track,
    span: StartRange,
    disturbance: DisturbanceRange,
    target: jax.Array,
    drawn: jax.Array,
    part: jax.Array | None = None,
    recorded: RecordedStart | None = None,
) -> State:
    """The start of a vehicle at the gate before ``target``, of (draw_count(model),) numbers.

    ``part`` () of the leg to the target is behind it; None: nothing. Motion and actuators are those
    of ``recorded`` where it is used.
    """
    motion, actuators = Motion(*_pose(track, span, target, drawn, part)), drawn[12:]
    if recorded is not None:
        motion, actuators = recorded.instead_of(motion, actuators)
    state = model.start(c, motion, actuators, (span.thrust_low, span.thrust_high))
    if not model.disturbed:
        return state
    drawn = drawn[-DISTURBANCE_DRAWS:]
    moment = Vec3(disturbance.moment_x, disturbance.moment_y, disturbance.moment_z)
    moment_ext = Vec3.of(drawn[:3]) * moment + disturbance.moment_bias
    force_ext = Vec3.zero().replace(z=drawn[3] * disturbance.force_z)
    return model.with_disturbance(state, moment_ext, force_ext)


AROUND_START, YAW_OF_START = 0.5, math.pi / 4.0  # half-widths of x and y, m, and of the yaw, rad


def hover(model: VehicleModel, c: Constants, track: Track, drawn: jax.Array | None = None) -> State:
    """At rest and level at the track's start, or the last gate, nose towards the first gate.

    On the ground the actuators are at their lowest, elsewhere those of a hover. ``drawn`` (3,) in
    [-1, 1] moves x, y and the yaw by ``AROUND_START`` and ``YAW_OF_START``, as the ground starts
    of MonoRace (arXiv 2601.15222); None: exactly there.
    """
    if track.start is not None:
        position, yaw = track.start.position, track.start.yaw
    else:
        position = jax.tree.map(lambda x: x[-1], track.position)
        yaw = _heading(position, jax.tree.map(lambda x: x[0], track.position))
    if drawn is not None:
        aside = Vec3(drawn[0], drawn[1], jnp.zeros_like(drawn[2])) * AROUND_START
        position, yaw = position + aside, yaw + YAW_OF_START * drawn[2]
    motion = Motion(position, Vec3.zero(), Vec3.zero().replace(z=wrap_angle(yaw)), Vec3.zero())
    if track.start is None or not track.start.on_ground:
        return model.hover(c, motion)
    lowest = -jnp.ones(max(4, model.actuators.size))
    return model.start(c, motion, lowest, (jnp.zeros(()), jnp.zeros(())))


def towards(nominal: Constants, drone: Constants, width: jax.Array) -> Constants:
    """Constants between the nominal ones (width 0) and those of a drone (width 1)."""
    return jax.tree.map(lambda x, other: x + width * (other - x), nominal, drone)


def draw_constants(nominal: Constants, spread: Constants, drawn: jax.Array) -> Constants:
    """Constants of one episode: each scaled by its own draw from 1 +- its fraction in ``spread``.

    ``drawn`` holds one number in [-1, 1] for each constant.
    """
    structure = jax.tree.structure(nominal)
    factors = jax.tree.unflatten(structure, [drawn[i] for i in range(structure.num_leaves)])
    return jax.tree.map(lambda x, part, draw: x * (1.0 + part * draw), nominal, spread, factors)
