"""Starts of episodes: states, disturbances and constants."""

import functools
import math
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.frames import wrap_angle
from quadjax.core.gradients import Scalar
from quadjax.core.sections import Field, Section, Unit
from quadjax.core.traced import register
from quadjax.core.vectors import Vec3, safe_norm
from quadjax.race.random_track import RandomTracks
from quadjax.race.recorded_starts import RecordedStart
from quadjax.race.track import Coordinate, Track, gate, gate_count, pick
from quadjax.vehicle.protocol import Constants, Motion, State, VehicleModel

HalfWidth = Annotated[float, Field(ge=0, le=1e6)]
Share = Annotated[float, Field(ge=0, le=0.9)]
FROM_GROUND = 0.1  # default part of the episodes that begin on the ground, where races do
AROUND_START, YAW_OF_START = 0.5, math.pi / 4.0  # half-widths of x and y, m, and of the yaw, rad


@register
class Start(Section):
    """The uniform distribution of an episode's start; the defaults are the paper's."""

    gate: Literal["first", "random"] = Field(
        "first", description="target of a start: the first gate or any; starts at the one before it"
    )
    heading: Literal["north", "inside_turn"] = Field(
        "north", description="center of the start's yaw: north, or to the inside of the turn"
    )
    stagger_clocks: bool = Field(
        False, description="start at a random step of the episode's clock, so that resets spread"
    )
    along_leg: float = Field(
        0.0,
        ge=0,
        le=1,
        description="farthest start on the way from the gate before to the target gate, as a "
        "fraction of it; the way is a cubic curve that leaves and enters the gates along their "
        "yaw; starts are uniform up to there",
    )
    race: float | None = Field(
        None,
        ge=0,
        le=1,
        description="part of the episodes that begin as a race: at rest at the track's start (or "
        "in the last gate), x and y within 0.5 m, yaw within 45 deg; null: 0.1 where the track's "
        "start is on the ground, else 0",
    )
    position: Annotated[HalfWidth, Unit("m")] = Field(
        0.5, description="half-width about the point on the leg, m"
    )
    velocity: Annotated[HalfWidth, Unit("m/s")] = Field(
        0.5, description="half-width of each component, m/s"
    )
    roll_pitch_deg: Annotated[float, Unit("deg")] = Field(
        40.0, ge=0, le=89, description="half-width of roll and pitch"
    )
    yaw_deg: Annotated[float, Unit("deg")] = Field(
        180.0, ge=0, le=180, description="half-width of yaw about the heading"
    )
    body_rates: Annotated[HalfWidth, Unit("1/s")] = Field(
        1.0, description="half-width of each component, rad/s"
    )
    thrust: tuple[HalfWidth, HalfWidth] = Field(
        (7.4, 7.6), description="lowest and highest thrust, m/s^2; model rate"
    )


@register
class Disturbance(Section):
    """External disturbances, drawn per episode and constant in it."""

    moment_x: HalfWidth = Field(
        0.0, description="half-width, N m with model motor, else rad/s^2; the paper: 0.03"
    )
    moment_y: HalfWidth = Field(
        0.0, description="half-width, N m with model motor, else rad/s^2; the paper: 0.03"
    )
    moment_z: HalfWidth = Field(
        0.0, description="half-width, N m with model motor, else rad/s^2; the paper: 0.01"
    )
    force_z: HalfWidth = Field(0.0, description="half-width, m/s^2; the paper: 0.5")
    moment_bias: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="moment added in every episode, in the unit of moment_x, body"
    )

    @property
    def half_widths(self) -> dict[str, float]:
        """The drawn ranges by name, without the bias: what scales the observation."""
        return {key: value for key, value in self.__dict__.items() if key != "moment_bias"}


class Randomization(Section):
    """Domain randomization: largest relative error of each constant, drawn in every episode.

    A constant has the fraction of its group or that of ``all``, whichever is larger.
    """

    all: Share = Field(0.0, description="every constant of the groups except gravity")
    gravity: Share = Field(0.0, description="g")
    inertia: Share = Field(0.0, description="moments of inertia")
    thrust: Share = Field(0.0, description="thrust coefficient, or mass")
    drag: Share = Field(0.0, description="drag coefficients")
    moment: Share = Field(0.0, description="roll and pitch moment coefficients")
    velocity_moment: Share = Field(0.0, description="moments of translational flight")
    yaw: Share = Field(0.0, description="yaw moment coefficients")
    lag: Share = Field(0.0, description="time constants")
    limits: Share = Field(0.0, description="lowest and highest commands or rotor speeds")
    motor_map: Share = Field(0.0, description="curvature of the motor map; models racing, a2rl")
    gyroscopic: Share = Field(0.0, description="gyroscopic coupling; model a2rl")
    aerodynamics: Share = Field(
        0.0, description="quadratic drag, angle of attack and advance; model a2rl"
    )
    constants: dict[str, Share] = Field(
        {},
        max_length=100,
        description="fractions of single constants, which override their group: {w_max: 0.15}",
    )

    population: str | None = Field(
        None,
        description="population of the model that all constants are drawn from, in place of "
        "fractions: all_racing_drones (model racing; arXiv 2504.21586), monorace_fastest or "
        "monorace_robust (model a2rl; arXiv 2601.15222)",
    )
    width: float = Field(
        1.0,
        ge=0,
        le=1,
        description="factor on all fractions, and on the difference between a drone of the "
        "population and the nominal one; schedule it for a curriculum",
    )
    tracks: RandomTracks | None = Field(
        None,
        description="random tracks, one of which is drawn for every training episode in place of "
        "track: count and the keys of track.generate; flights of evaluations are on "
        "track",
    )

    @property
    def drawn(self) -> bool:
        """Whether constants are drawn."""
        return any(v for key, v in self.__dict__.items() if key not in ("width", "tracks"))

    def by_constant(self, model: VehicleModel) -> dict[str, float]:
        """The fraction of each constant of a vehicle model."""
        fractions = dict.fromkeys(model.constant_names, 0.0)
        for group, names in model.groups.items():
            lowest = 0.0 if group == "gravity" else self.all
            fractions |= dict.fromkeys(names, max(getattr(self, group), lowest))
        return {
            name: self.width * fraction for name, fraction in (fractions | self.constants).items()
        }


class Draws(struct.PyTreeNode):
    """The random numbers of one start, each in [-1, 1]."""

    gate: jax.Array  # ()
    clock: jax.Array  # ()
    position: jax.Array  # (3,)
    velocity: jax.Array  # (3,)
    euler: jax.Array  # (3,)
    rates: jax.Array  # (3,)
    actuators: jax.Array  # (at least 4,)
    disturbance: jax.Array  # (4,) of the moment and the force
    constants: jax.Array  # (n,)


def vector(x: Scalar, y: Scalar, z: Scalar) -> Vec3:
    """A vector of the numbers of a section."""
    return Vec3(jnp.asarray(x), jnp.asarray(y), jnp.asarray(z))


def draw(key: jax.Array, count: int) -> jax.Array:
    """Uniform numbers in [-1, 1], (count,); one call for all, which compiles much faster."""
    return jax.random.uniform(key, (count,), minval=-1.0, maxval=1.0)


def draw_start(model: VehicleModel, key: jax.Array, constants: int = 0) -> Draws:
    """The random numbers of a start, with those of a number of constants."""
    sizes = (1, 1, 3, 3, 3, 3, max(4, model.actuators.size), 4, constants)
    numbers, parts, first = draw(key, sum(sizes)), [], 0
    for size in sizes:
        parts.append(numbers[first : first + size])
        first += size
    return Draws(parts[0][0], parts[1][0], *parts[2:])


def start_gate(track: Track, number: jax.Array) -> jax.Array:
    """Index () of a gate, any with equal chance, of a number drawn from [-1, 1]."""
    count = gate_count(track)
    return jnp.minimum((0.5 * (number + 1.0) * count).astype(jnp.int32), count - 1)


def _way(track: Track, target: jax.Array, fraction: jax.Array) -> Vec3:
    """The point, m, at a ``fraction`` () of the way from the gate before to the target gate.

    The way is a cubic Hermite curve with the horizontal headings of both gates and the length of
    the leg as the length of its tangents. Its height lies between those of the gates. The curve
    from the start of a course has no tangent there.
    """
    count = gate_count(track)
    before, after = gate(track, (target + count - 1) % count), gate(track, target)
    begin, heading = before.position, Vec3(before.cos_yaw, before.sin_yaw, jnp.zeros_like(fraction))
    if not track.closed and track.start is not None:
        first = functools.partial(jnp.where, target == 0)
        begin = jax.tree.map(first, track.start.position, begin)
        heading = jax.tree.map(first, Vec3.zero(), heading)
    leg = after.position - begin
    length, left = safe_norm(leg), 1.0 - fraction
    leave, enter = length * fraction * left**2, -length * fraction**2 * left
    arrival = Vec3(after.cos_yaw, after.sin_yaw, jnp.zeros_like(fraction))
    return begin + leg * (fraction**2 * (3.0 - 2.0 * fraction)) + heading * leave + arrival * enter


def start_motion(
    track: Track,
    ranges: Start,
    heading: jax.Array | None,
    target: jax.Array,
    draws: Draws,
    fraction: jax.Array | None,
) -> Motion:
    """The motion of a start around a point of the way to a target gate.

    Args:
        track: of the race.
        ranges: half-widths, as leaves.
        heading: (gates,) rad, center of the yaw by target gate; None: north.
        target: () index of the gate.
        draws: random numbers.
        fraction: () of the leg to the target that is behind the drone; None: nothing.
    """
    position = _way(track, target, jnp.zeros(()) if fraction is None else fraction)
    roll_pitch, yaw = ranges.roll_pitch_deg, ranges.yaw_deg  # rad, as leaves
    euler = Vec3.of(draws.euler) * vector(roll_pitch, roll_pitch, yaw)
    if heading is not None:
        euler = euler.replace(z=wrap_angle(euler.z + pick(heading, target)))
    return Motion(
        position + Vec3.of(draws.position) * ranges.position,
        Vec3.of(draws.velocity) * ranges.velocity,
        euler,
        Vec3.of(draws.rates) * ranges.body_rates,
    )


def start(
    model: VehicleModel,
    c: Constants,
    motion: Motion,
    thrust: tuple[Scalar, Scalar],
    disturbance: Disturbance,
    draws: Draws,
    recorded: RecordedStart | None = None,
) -> State:
    """The start of a vehicle: motion, drawn actuators and drawn external disturbances.

    Motion and actuators are those of ``recorded`` where it is used.
    """
    actuators = draws.actuators
    if recorded is not None:
        motion, actuators = recorded.instead_of(motion, actuators)
    low, high = map(jnp.asarray, thrust)
    state = model.start(c, motion, actuators, (low, high))
    if not model.disturbed:
        return state
    widths = vector(disturbance.moment_x, disturbance.moment_y, disturbance.moment_z)
    moment = Vec3.of(draws.disturbance[:3]) * widths + vector(*disturbance.moment_bias)
    force = Vec3.zero().replace(z=draws.disturbance[3] * disturbance.force_z)
    return model.with_disturbance(state, moment, force)


def _heading(begin: Vec3, end: Vec3) -> jax.Array:
    """The heading (), rad, from one point to another."""
    return jnp.arctan2(end.y - begin.y, end.x - begin.x)


def hover(model: VehicleModel, c: Constants, track: Track, moved: jax.Array | None = None) -> State:
    """At rest and level at the track's start, or the last gate, nose towards the first gate.

    On the ground the actuators are at their lowest, elsewhere those of a hover. ``moved`` (3,) in
    [-1, 1] moves x, y and the yaw by ``AROUND_START`` and ``YAW_OF_START``, as the ground starts
    of MonoRace (arXiv 2601.15222); None: exactly there.
    """
    if track.start is not None:
        position, yaw = track.start.position, track.start.yaw
    else:
        position = jax.tree.map(lambda x: x[-1], track.position)
        yaw = _heading(position, jax.tree.map(lambda x: x[0], track.position))
    if moved is not None:
        aside = Vec3(moved[0], moved[1], jnp.zeros_like(moved[2])) * AROUND_START
        position, yaw = position + aside, yaw + YAW_OF_START * moved[2]
    motion = Motion(position, Vec3.zero(), Vec3.zero().replace(z=wrap_angle(yaw)), Vec3.zero())
    if track.start is None or not track.start.on_ground:
        return model.hover(c, motion)
    lowest = -jnp.ones(max(4, model.actuators.size))
    return model.start(c, motion, lowest, (jnp.zeros(()), jnp.zeros(())))


def towards(nominal: Constants, drone: Constants, width: jax.Array) -> Constants:
    """Constants between the nominal ones (width 0) and those of a drone (width 1)."""
    return jax.tree.map(lambda x, other: x + width * (other - x), nominal, drone)


def draw_constants(nominal: Constants, spread: Constants, numbers: jax.Array) -> Constants:
    """Constants of one episode: each scaled by its own draw from 1 +- its fraction in ``spread``.

    ``numbers`` holds one number in [-1, 1] for each constant.
    """
    count = len(jax.tree.leaves(nominal))
    factors = jax.tree.unflatten(jax.tree.structure(nominal), [numbers[i] for i in range(count)])
    return jax.tree.map(lambda x, width, draw: x * (1.0 + width * draw), nominal, spread, factors)
