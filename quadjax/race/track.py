"""Tracks: gates in a fixed cyclic order. World NED, m, rad."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.frames import Attitude, attitude, world_to_body, wrap_angle
from quadjax.core.vectors import Vec3

AHEAD = 5.0  # m, from the last gate of a course to the gate that is observed after it


@struct.dataclass
class Pose:
    """A place and a heading."""

    position: Vec3  # m, world
    yaw: jax.Array  # () rad
    on_ground: bool = struct.field(pytree_node=False, default=False)  # at rest, not in hover


@struct.dataclass
class Track:
    """Gates as arrays over the gates, with what the observation needs of the one after each."""

    position: Vec3  # of (gates,): centers, m, world
    yaw: jax.Array  # (gates,) heading of the way through, rad
    cos_yaw: jax.Array  # (gates,)
    sin_yaw: jax.Array  # (gates,)
    half_width: jax.Array  # (gates,) m
    half_height: jax.Array  # (gates,) m
    next_position: Vec3  # of (gates,): the next gate's center in this gate's frame, m
    next_yaw: jax.Array  # (gates,) the next gate's yaw relative to this gate's, in [-pi, pi], rad
    opening: Attitude | None = None  # of (gates,): roll, pitch and yaw; None: all upright
    circle: jax.Array | None = None  # (gates,) bool, round openings; None: all rectangles
    start: Pose | None = None  # of timed laps; None: at the last gate
    # Whether the first gate follows the last; else the race ends with the last gate.
    closed: bool = struct.field(pytree_node=False, default=True)


@struct.dataclass
class Gate:
    """One gate of a track: the fields of ``Track`` at one index."""

    position: Vec3
    yaw: jax.Array
    cos_yaw: jax.Array
    sin_yaw: jax.Array
    half_width: jax.Array
    half_height: jax.Array
    next_position: Vec3
    next_yaw: jax.Array
    opening: Attitude | None = None
    circle: jax.Array | None = None


def make_track(
    position: jax.Array,
    yaw: jax.Array,
    size: jax.Array,
    tilt: jax.Array | None = None,
    circle: jax.Array | None = None,
    start: Pose | None = None,
    closed: bool = True,
) -> Track:
    """A track of gates in flying order.

    Args:
        position: (gates, 3) centers, m, world NED.
        yaw: (gates,) heading of the way through, rad.
        size: (gates, 2) width and height of the opening, m.
        tilt: (gates, 2) roll and pitch of the gates, rad; None: all upright.
        circle: (gates,) whether the opening is round; None: all are rectangles.
        start: of timed laps; None: at the last gate.
        closed: whether the first gate follows the last. Where it does not, the observed gate after
            the last one is straight ahead, ``AHEAD`` m, in the same direction.
    """
    opening = None if tilt is None else attitude(Vec3(tilt[:, 0], tilt[:, 1], yaw))
    cosine, sine = jnp.cos(yaw), jnp.sin(yaw)
    to_next = Vec3.of(jnp.roll(position, -1, axis=0) - position)
    next_yaw = jnp.roll(yaw, -1) - yaw
    if not closed:
        ahead = AHEAD * jnp.stack([cosine[-1], sine[-1], jnp.zeros_like(sine[-1])])
        to_next = Vec3(*(x.at[-1].set(own) for x, own in zip(to_next, ahead, strict=True)))
        next_yaw = next_yaw.at[-1].set(0.0)
    return Track(
        position=Vec3.of(position),
        yaw=yaw,
        cos_yaw=cosine,
        sin_yaw=sine,
        half_width=0.5 * size[:, 0],
        half_height=0.5 * size[:, 1],
        next_position=Vec3(
            cosine * to_next.x + sine * to_next.y,
            -sine * to_next.x + cosine * to_next.y,
            to_next.z,
        ),
        next_yaw=wrap_angle(next_yaw),
        opening=opening,
        circle=circle,
        start=start,
        closed=closed,
    )


def gate_count(track: Track) -> int:
    """The number of gates of a track: static."""
    return track.yaw.shape[0]


def pick(table: jax.Array, index: jax.Array) -> jax.Array:
    """The entry () of a table (gates,) at ``index`` (), by selects rather than a gather.

    A gather is a scalar loop on a CPU; selects over a handful of gates vectorize over the drones.
    """
    value = table[0]
    for other in range(1, table.shape[0]):
        value = jnp.where(index == other, table[other], value)
    return value


def gate(track: Track, index: jax.Array) -> Gate:
    """The gate at ``index`` ()."""
    return _gate(track, lambda table: pick(table, index))


def gate_at(track: Track, index: int) -> Gate:
    """The gate at a static index."""
    return _gate(track, lambda table: table[index])


def _gate(track: Track, of: Callable[[jax.Array], jax.Array]) -> Gate:
    names = (name for name in vars(track) if name not in ("start", "closed"))
    return Gate(**{name: jax.tree.map(of, getattr(track, name)) for name in names})


def gates_ahead(track: Track, count: int) -> tuple[Vec3, jax.Array]:
    """The pose of the gate that is ``count`` gates after each gate, in that gate's frame.

    On a course, the gates after the last one are straight ahead, ``AHEAD`` m from each other.

    Returns:
        Position of (gates,), m, and relative yaw (gates,), rad, in [-pi, pi].
    """
    position, yaw = track.next_position, track.next_yaw

    def following(table: jax.Array) -> jax.Array:
        rolled = jnp.roll(table, -1)
        return rolled if track.closed else rolled.at[-1].set(table[-1])

    for _ in range(count - 1):
        step, turn = jax.tree.map(following, (position, yaw))
        cosine, sine = jnp.cos(track.next_yaw), jnp.sin(track.next_yaw)
        across = Vec3(cosine * step.x - sine * step.y, sine * step.x + cosine * step.y, step.z)
        position, yaw = track.next_position + across, wrap_angle(track.next_yaw + turn)
    return position, yaw


STRAIGHT = 0.2  # below this sum of the sines of the turns at a leg's ends, the leg is straight


def inside_turn(track: Track) -> jax.Array:
    """The yaw (gates,), rad, across the leg to each gate, towards the inside of its turn.

    The side is the one to which the direction changes from the leg before to the leg after; where
    it hardly changes, the yaw is along the leg.
    """
    position = jnp.stack([track.position.x, track.position.y], axis=-1)
    leg = position - jnp.roll(position, 1, axis=0)
    way = leg / jnp.maximum(jnp.linalg.norm(leg, axis=-1, keepdims=True), 1e-6)
    turn = jnp.roll(way, -1, axis=0) - jnp.roll(way, 1, axis=0)
    right = jnp.stack([-way[:, 1], way[:, 0]], axis=-1)
    bend = jnp.sum(right * turn, axis=-1, keepdims=True)  # to the right, if positive
    look = jnp.where(jnp.abs(bend) < STRAIGHT, way, jnp.sign(bend) * right)
    return jnp.arctan2(look[:, 1], look[:, 0])


def to_gate_frame(g: Gate, vector: Vec3) -> Vec3:
    """A world-frame vector in the gate's level frame: x ahead, y to its right, z down.

    ``ahead`` is the horizontal direction of the yaw, also of a gate that is tilted.
    """
    x, y = vector.x, vector.y
    return Vec3(g.cos_yaw * x + g.sin_yaw * y, -g.sin_yaw * x + g.cos_yaw * y, vector.z)


def to_opening_frame(g: Gate, vector: Vec3) -> Vec3:
    """A world-frame vector in the opening's frame: x through it, y along its width, z its height.

    The gate's frame, turned by the gate's pitch and roll.
    """
    return to_gate_frame(g, vector) if g.opening is None else world_to_body(g.opening, vector)
