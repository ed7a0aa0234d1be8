"""Starts: where an episode begins, with which disturbance and which constants."""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.race.observation import DisturbanceRange
from quadjax.race.track import Track, gate, gate_count
from quadjax.vehicle.constants import GROUPS, Constants, MotorConstants, RateConstants
from quadjax.vehicle.frames import wrap_angle
from quadjax.vehicle.motor import MotorState, hover_rpm
from quadjax.vehicle.rate import RateState
from quadjax.vehicle.vector import Rotors, Vec3


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


def uniform(key: jax.Array, shape: tuple[int, ...], half: jax.Array) -> jax.Array:
    """Uniform numbers in [-half, half]."""
    return half * jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def start_gate(track: Track, key: jax.Array, random_gate: bool) -> jax.Array:
    """Index () of the first target: the first gate, or any with equal chance."""
    if random_gate:
        return jax.random.randint(key, (), 0, gate_count(track))
    return jnp.zeros((), jnp.int32)


def _pose(
    track: Track, span: StartRange, target: jax.Array, key: jax.Array
) -> tuple[Vec3, Vec3, Vec3, Vec3]:
    """Position, velocity, Euler angles and body rates around the gate before the target."""
    count = gate_count(track)
    keys = jax.random.split(key, 4)
    before = gate(track, (target + count - 1) % count)
    angle = jnp.stack([span.roll_pitch, span.roll_pitch, span.yaw])
    return (
        before.position + Vec3.of(uniform(keys[0], (3,), span.position)),
        Vec3.of(uniform(keys[1], (3,), span.velocity)),
        Vec3.of(uniform(keys[2], (3,), angle)),
        Vec3.of(uniform(keys[3], (3,), span.rates)),
    )


def start_motor(
    c: MotorConstants,
    track: Track,
    span: StartRange,
    disturbance: DisturbanceRange,
    target: jax.Array,
    key: jax.Array,
) -> MotorState:
    """A random start of the motor-level vehicle, at the gate before ``target``."""
    pose_key, rpm_key, moment_key, force_key = jax.random.split(key, 4)
    position, velocity, euler, rates = _pose(track, span, target, pose_key)
    moment = jnp.stack([disturbance.moment_x, disturbance.moment_y, disturbance.moment_z])
    force_z = uniform(force_key, (), disturbance.force_z)
    return MotorState(
        position=position,
        velocity=velocity,
        euler=euler,
        rates=rates,
        rpm=Rotors.of(c.rpm_min + (c.rpm_max - c.rpm_min) * jax.random.uniform(rpm_key, (4,))),
        moment_ext=Vec3.of(uniform(moment_key, (3,), moment)),
        force_ext=Vec3.zero().replace(z=force_z),
    )


def start_rate(
    c: RateConstants, track: Track, span: StartRange, target: jax.Array, key: jax.Array
) -> RateState:
    """A random start of the rate-level vehicle, at the gate before ``target``."""
    pose_key, thrust_key = jax.random.split(key)
    position, velocity, euler, rates = _pose(track, span, target, pose_key)
    width = span.thrust_high - span.thrust_low
    thrust = span.thrust_low + width * jax.random.uniform(thrust_key, ())
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
    heading = jnp.arctan2(first.y - last.y, first.x - last.x)
    euler = Vec3.zero().replace(z=wrap_angle(heading))
    pose = (last, Vec3.zero(), euler, Vec3.zero())
    if isinstance(c, MotorConstants):
        rpm = jnp.clip(hover_rpm(c), c.rpm_min, c.rpm_max)
        return MotorState(*pose, Rotors.same(rpm), Vec3.zero(), Vec3.zero())
    return RateState(*pose, jnp.clip(c.g, c.thrust_min, c.thrust_max))


def draw_constants(nominal: Constants, spread: RandomiseFractions, key: jax.Array) -> Constants:
    """Constants of one episode: each scaled by its own draw from 1 +- its group's fraction."""
    fraction = {name: getattr(spread, group) for group, names in GROUPS.items() for name in names}
    names = [field.name for field in dataclasses.fields(nominal)]
    draws = jax.random.uniform(key, (len(names),), minval=-1.0, maxval=1.0)
    return nominal.replace(
        **{
            name: getattr(nominal, name) * (1.0 + fraction[name] * draws[index])
            for index, name in enumerate(names)
        }
    )
