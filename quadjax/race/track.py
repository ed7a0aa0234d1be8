"""Tracks: gates in a fixed cyclic order. World NED, m, rad."""

import functools
import itertools
import math
from typing import Annotated, Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.frames import Attitude, body_to_world, world_to_body, wrap_angle
from quadjax.core.materialize import materialized
from quadjax.core.sections import ORDERED, Field, Section, refuse
from quadjax.core.trigonometry import sincos
from quadjax.core.vectors import Vec3
from quadjax.race.random_track import MAX_COORDINATE_M, RandomTrack, RandomTracks, generate

Coordinate = Annotated[float, Field(ge=-MAX_COORDINATE_M, le=MAX_COORDINATE_M)]
Span = Annotated[tuple[Coordinate, Coordinate], ORDERED]
STRAIGHT_AHEAD_M = 5.0  # from the last gate of a course to the gate that is observed after it
FULL_TURN_RAD = np.float32(2.0 * np.pi)
STRAIGHT_SINE_SUM = 0.2  # of the turns at a leg's ends, below which it is straight


class GateSection(Section):
    """One gate, in the world frame."""

    position: tuple[Coordinate, Coordinate, Coordinate] = Field(
        description="center x, y, z, m; z < 0 is above 0; at most 10 km from the origin, where "
        "float32 has steps of 1 mm"
    )
    yaw_deg: float = Field(0.0, ge=-720, le=720, description="direction of passage, deg")
    size: tuple[Annotated[float, Field(gt=0, le=100)], Annotated[float, Field(gt=0, le=100)]] = (
        Field((1.0, 1.0), description="width and height of the opening, m")
    )
    pitch_deg: float = Field(
        0.0, ge=-90, le=90, description="upward slope of the passage, deg: -90 is straight down"
    )
    roll_deg: float = Field(
        0.0, ge=-180, le=180, description="rotation of the opening about the passage, deg"
    )
    shape: Literal["rectangle", "circle"] = Field(
        "rectangle", description="shape of the opening; a circle has size [diameter, diameter]"
    )

    @property
    def axes(self) -> list[list[float]]:
        """The matrix with columns through the gate, along its width and along its height, NED."""
        angles = [math.radians(x) for x in (self.roll_deg, self.pitch_deg, self.yaw_deg)]
        (sr, sp, sy), (cr, cp, cy) = map(math.sin, angles), map(math.cos, angles)
        return [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]


class TrackStart(Section):
    """Where a timed race starts."""

    position: tuple[Coordinate, Coordinate, Coordinate] = Field(description="x, y, z, m")
    yaw_deg: float = Field(0.0, ge=-720, le=720, description="heading, deg")


class TrackSection(Section):
    """The gates, in the order of passage."""

    file: str | None = Field(
        None,
        description="YAML file with the name and the gates, next to the config or in "
        "configs/tracks; loading copies its values into the config and sets this to null "
        "(default: square4.yaml)",
    )
    generate: RandomTrack | None = Field(
        None,
        description="random track in place of gates: {seed, gates, leg, leg_ratio, turn_deg, "
        "yaw_deg, height, size, frame}; loading writes its gates into the config and sets "
        "this to null",
    )
    name: str = Field("", description="name of the track, for tables and figures")
    gates: tuple[GateSection, ...] = Field(
        min_length=1,
        max_length=100,
        description="list of {position, yaw_deg, size, pitch_deg, roll_deg, shape}",
    )
    opening: float | None = Field(
        None,
        gt=0,
        le=100,
        description="width and height of the openings of all gates, m, in place of their sizes; "
        "the outer edges of frames (rules.gate_frame) stay; loading writes the sizes into the "
        "gates and sets this to null",
    )
    start: TrackStart | None = Field(
        None,
        description="{position, yaw_deg} of the hover from which timed laps start; null: the last "
        "gate's center, nose toward the first gate",
    )
    closed: bool = Field(
        True,
        description="whether the first gate follows the last; false: a course, which ends at the "
        "last gate and needs a start",
    )


def check_lap(section: TrackSection) -> None:
    """Check that a lap has another gate than the one that it starts from.

    Raises:
        InputError: a closed track of one gate.
    """
    if section.closed and len(section.gates) == 1:
        refuse("track.gates", "1 gate", "two gates or more, or a course (track.closed=false)")


class Pose(struct.PyTreeNode):
    """A place and a heading."""

    position: Vec3  # m, world
    yaw: jax.Array  # () rad
    on_ground: bool = struct.field(pytree_node=False, default=False)  # at rest, not in hover


class Gate(struct.PyTreeNode):
    """One gate, with what the observation needs of the one after it."""

    position: Vec3  # center, m, world
    yaw: jax.Array  # heading of the way through, rad
    cos_yaw: jax.Array
    sin_yaw: jax.Array
    half_width: jax.Array  # m
    half_height: jax.Array  # m
    next_position: Vec3  # the next gate's center in this gate's frame, m
    next_yaw: jax.Array  # the next gate's yaw relative to this gate's, in [-pi, pi], rad
    attitude: Attitude | None = None  # of the opening: roll, pitch and yaw; None: upright
    circle: jax.Array | None = None  # bool, whether the opening is round; None: a rectangle


class Track(Gate):
    """All gates as one ``Gate`` (a struct of arrays), and where the race starts and ends.

    Each number is an array (gates,).
    """

    start: Pose | None = None  # of timed laps; None: at the last gate
    # Whether the first gate follows the last; else the race ends with the last gate.
    closed: bool = struct.field(pytree_node=False, default=True)


def make_track(section: TrackSection) -> Track:
    """The arrays of a track of a config.

    Where the last gate is not followed by the first, the observed gate after it is straight ahead,
    ``STRAIGHT_AHEAD_M``, in the same direction.
    """
    gates, closed = section.gates, section.closed
    position = np.array([g.position for g in gates], np.float32)
    size = np.array([g.size for g in gates], np.float32)
    angles = np.radians([(g.roll_deg, g.pitch_deg, g.yaw_deg) for g in gates]).astype(np.float32)
    roll, pitch, yaw = angles.T
    circle = np.array([g.shape == "circle" for g in gates])
    # NumPy compiles nothing; cosine and sine are JAX's, which equal those of compiled programs.
    with jax.ensure_compile_time_eval():  # also where a program is traced
        cosine, sine = np.asarray(jnp.cos(yaw)), np.asarray(jnp.sin(yaw))
    to_next = np.roll(position, -1, axis=0) - position
    next_yaw = np.roll(yaw, -1) - yaw
    if not closed:
        ahead = np.array([cosine[-1], sine[-1], 0.0], np.float32)
        to_next[-1], next_yaw[-1] = STRAIGHT_AHEAD_M * ahead, 0.0
    x, y, z = to_next.T
    start = None
    if section.start is not None:
        place, angle = section.start.position, math.radians(section.start.yaw_deg)
        start = Pose(Vec3(*map(jnp.float32, place)), jnp.float32(angle), place[2] == 0)
    tilted = [sincos(jnp.asarray(x)) for x in (roll, pitch, yaw)] if angles[:, :2].any() else []
    numbers = {
        "position": Vec3(*position.T),
        "yaw": yaw,
        "cos_yaw": cosine,
        "sin_yaw": sine,
        "half_width": np.float32(0.5) * size[:, 0],
        "half_height": np.float32(0.5) * size[:, 1],
        "next_position": Vec3(cosine * x + sine * y, -sine * x + cosine * y, z),
        "next_yaw": next_yaw - FULL_TURN_RAD * np.rint(next_yaw / FULL_TURN_RAD),
        "circle": circle if circle.any() else None,
    }
    attitude = Attitude(*itertools.chain(*tilted)) if tilted else None
    arrays: dict[str, Any] = jax.tree.map(jnp.asarray, numbers)
    return Track(**arrays, attitude=attitude, start=start, closed=closed)


@functools.lru_cache(maxsize=4)
def make_tracks(settings: RandomTracks) -> tuple[Track, float]:
    """Random tracks as one, with (tracks, gates) of each number, and their position limit, m.

    Raises:
        InputError: settings for which no track was found.
    """
    trees = [generate(track) for track in settings.each]
    tracks = [make_track(TrackSection(gates=tree["gates"])) for tree in trees]
    limit = max(tree["rules"]["position_limit"] for tree in trees)
    return jax.tree.map(lambda *leaves: jnp.asarray(np.stack(leaves)), *tracks), limit


def gate_count(track: Track) -> int:
    """The number of gates of a track: static."""
    return track.yaw.shape[0]


def pick(table: jax.Array, index: jax.Array | int) -> jax.Array:
    """The entry () of a table (gates,) at ``index`` (), by selects rather than a gather.

    A gather is a scalar loop on a CPU; selects over a handful of gates vectorize over the drones.
    """
    if isinstance(index, int):
        return table[index]
    value = table[0]
    for other in range(1, table.shape[0]):
        value = jnp.where(index == other, table[other], value)
    return value


@materialized(gradients=True)
def gate(track: Track, index: jax.Array | int) -> Gate:
    """The gate at ``index`` ()."""
    names = Gate.__dataclass_fields__
    pick_each = functools.partial(pick, index=index)
    return Gate(**{name: jax.tree.map(pick_each, getattr(track, name)) for name in names})


def gates_ahead(track: Track, count: int) -> tuple[Vec3, jax.Array]:
    """The pose of the gate that is ``count`` gates after each gate, in that gate's frame.

    On a course, the gates after the last one are straight ahead, ``STRAIGHT_AHEAD_M`` apart.

    Returns:
        Position of (gates,), m, and relative yaw (gates,), rad, in [-pi, pi].
    """
    position, yaw = track.next_position, track.next_yaw

    def of_next_gate(table: jax.Array) -> jax.Array:
        rolled = jnp.roll(table, -1)
        return rolled if track.closed else rolled.at[-1].set(table[-1])

    for _ in range(count - 1):
        step, turn = jax.tree.map(of_next_gate, (position, yaw))
        cosine, sine = jnp.cos(track.next_yaw), jnp.sin(track.next_yaw)
        across = Vec3(cosine * step.x - sine * step.y, sine * step.x + cosine * step.y, step.z)
        position, yaw = track.next_position + across, wrap_angle(track.next_yaw + turn)
    return position, yaw


def unwrapped_turns(track: Track) -> jax.Array:
    """The plain difference (gates,) of the next gate's yaw and each gate's, rad.

    0 at the last gate of a course, as ``Gate.next_yaw``.
    """
    turns = jnp.roll(track.yaw, -1) - track.yaw
    return turns if track.closed else turns.at[-1].set(0.0)


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
    look = jnp.where(jnp.abs(bend) < STRAIGHT_SINE_SUM, way, jnp.sign(bend) * right)
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
    return to_gate_frame(g, vector) if g.attitude is None else world_to_body(g.attitude, vector)


def through_opening(g: Gate) -> Vec3:
    """The direction of passage, a unit vector in the world frame: x of the opening's frame."""
    zero = jnp.zeros_like(g.cos_yaw)
    if g.attitude is None:
        return Vec3(g.cos_yaw, g.sin_yaw, zero)
    return body_to_world(g.attitude, Vec3(zero + 1.0, zero, zero))
