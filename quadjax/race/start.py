"""Starts: where an episode begins, with which disturbance and which constants."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.frames import wrap_angle
from quadjax.core.vectors import Rotors, Vec3
from quadjax.race.observation import DisturbanceRange
from quadjax.race.track import Track, gate, gate_count, pick
from quadjax.vehicle.constants import GROUPS, Constants, MotorConstants, RateConstants
from quadjax.vehicle.motor import MotorState, hover_rpm
from quadjax.vehicle.rate import RateState


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
    # (gates,) rad, the yaw around which that of a start is drawn, by its target gate; None: north.
    facing: jax.Array | None = None


@struct.dataclass
class RandomiseFractions:
    """How far each constant of a group is drawn from its nominal value: +-fraction of it."""

    gravity: jax.Array
    inertia: jax.Array
    thrust: jax.Array
    drag: jax.Array
    moment: jax.Array
    velocity_moment: jax.Array
    yaw: jax.Array
    lag: jax.Array
    limits: jax.Array


DRAWS = 12 + 4 + 4  # pose and motion, actuators, disturbances: numbers that a start is made of


def draw(key: jax.Array, count: int) -> jax.Array:
    """Uniform numbers in [-1, 1], (count,); one call for all, which compiles much faster."""
    return jax.random.uniform(key, (count,), minval=-1.0, maxval=1.0)


def between(low: jax.Array, high: jax.Array, drawn: jax.Array) -> jax.Array:
    """A number drawn from [-1, 1] as one from [low, high]."""
    return low + 0.5 * (high - low) * (drawn + 1.0)


def start_gate(track: Track, drawn: jax.Array) -> jax.Array:
    """Index () of a gate, any with equal chance, of a number drawn from [-1, 1]."""
    count = gate_count(track)
    return jnp.minimum((0.5 * (drawn + 1.0) * count).astype(jnp.int32), count - 1)


def _pose(
    track: Track, span: StartRange, target: jax.Array, drawn: jax.Array
) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Position, velocity, Euler angles and body rates around the gate before the target."""
    count = gate_count(track)
    before = gate(track, (target + count - 1) % count)
    angle = Vec3(span.roll_pitch, span.roll_pitch, span.yaw)
    euler = Vec3.of(drawn[6:9]) * angle
    if span.facing is not None:
        euler = euler.replace(z=wrap_angle(euler.z + pick(span.facing, target)))
    return (
        before.position + Vec3.of(drawn[0:3]) * span.position,
        Vec3.of(drawn[3:6]) * span.velocity,
        euler,
        Vec3.of(drawn[9:12]) * span.rates,
    )


def _heading(begin: Vec3, end: Vec3) -> jax.Array:
    """The yaw (), rad, that looks from one point to another."""
    return jnp.arctan2(end.y - begin.y, end.x - begin.x)


def start_motor(
    c: MotorConstants,
    track: Track,
    span: StartRange,
    disturbance: DisturbanceRange,
    target: jax.Array,
    drawn: jax.Array,
) -> MotorState:
    """The start of the motor-level vehicle at the gate before ``target``, of (DRAWS,) numbers."""
    position, velocity, euler, rates = _pose(track, span, target, drawn)
    moment = Vec3(disturbance.moment_x, disturbance.moment_y, disturbance.moment_z)
    return MotorState(
        position=position,
        velocity=velocity,
        euler=euler,
        rates=rates,
        rpm=Rotors.of(between(c.rpm_min, c.rpm_max, drawn[12:16])),
        moment_ext=Vec3.of(drawn[16:19]) * moment + disturbance.steady_moment,
        force_ext=Vec3.zero().replace(z=drawn[19] * disturbance.force_z),
    )


def start_rate(
    c: RateConstants, track: Track, span: StartRange, target: jax.Array, drawn: jax.Array
) -> RateState:
    """The start of the rate-level vehicle at the gate before ``target``, of (DRAWS,) numbers."""
    position, velocity, euler, rates = _pose(track, span, target, drawn)
    thrust = between(span.thrust_low, span.thrust_high, drawn[12])
    return RateState(
        position=position,
        velocity=velocity,
        euler=euler,
        rates=rates,
        thrust=jnp.clip(thrust, c.thrust_min, c.thrust_max),
    )


def hover(c: Constants, track: Track) -> MotorState | RateState:
    """At rest and level at the last gate's centre, nose towards the first gate."""
    last = jax.tree.map(lambda x: x[-1], track.position)
    first = jax.tree.map(lambda x: x[0], track.position)
    euler = Vec3.zero().replace(z=wrap_angle(_heading(last, first)))
    pose = (last, Vec3.zero(), euler, Vec3.zero())
    if isinstance(c, MotorConstants):
        rpm = jnp.clip(hover_rpm(c), c.rpm_min, c.rpm_max)
        return MotorState(*pose, Rotors.same(rpm), Vec3.zero(), Vec3.zero())
    return RateState(*pose, jnp.clip(c.g, c.thrust_min, c.thrust_max))


def draw_constants(nominal: Constants, spread: RandomiseFractions, drawn: jax.Array) -> Constants:
    """Constants of one episode: each scaled by its own draw from 1 +- its group's fraction.

    ``drawn`` holds one number in [-1, 1] for each constant.
    """
    fraction = {name: getattr(spread, group) for group, names in GROUPS.items() for name in names}
    return nominal.replace(
        **{
            field.name: getattr(nominal, field.name) * (1.0 + fraction[field.name] * drawn[index])
            for index, field in enumerate(dataclasses.fields(nominal))
        }
    )
