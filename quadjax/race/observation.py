"""What a policy sees: 24 numbers for the motor-level vehicle, 17 for the rate-level one.

Both in the order of Ferede et al. (arXiv 2311.16948), from the target gate's frame.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.frames import wrap_angle
from quadjax.core.vectors import Vec3
from quadjax.race.track import Gate, to_gate_frame
from quadjax.vehicle.constants import MotorConstants, RateConstants
from quadjax.vehicle.motor import MotorState
from quadjax.vehicle.rate import RateState

MOTOR_SIZE = 24
RATE_SIZE = 17


@struct.dataclass
class DisturbanceRange:
    """Half-widths of the external disturbances drawn at reset, or of those that are observed."""

    moment_x: jax.Array  # N m
    moment_y: jax.Array
    moment_z: jax.Array
    force_z: jax.Array  # m/s^2
    steady_moment: Vec3  # N m, added to what is drawn


def pose_in_gate_frame(drone: MotorState | RateState, g: Gate) -> list[jax.Array]:
    """Position, velocity and Euler angles in the gate's frame, 9 numbers: m, m/s, rad.

    The yaw is the difference to the gate's, wrapped to [-pi, pi].
    """
    position = to_gate_frame(g, drone.position - g.position)
    velocity = to_gate_frame(g, drone.velocity)
    relative_yaw = wrap_angle(drone.euler.z - g.yaw)
    return [
        *position.components(),
        *velocity.components(),
        drone.euler.x,
        drone.euler.y,
        relative_yaw,
    ]


def scale_to_unit(value: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Map [low, high] to [-1, 1]."""
    return (2.0 * value - low - high) / (high - low)


def next_gate(g: Gate) -> list[jax.Array]:
    """The next gate's position, m, and yaw, rad, in the target gate's frame, 4 numbers."""
    return [*g.next_position.components(), g.next_yaw]


def _scaled_disturbance(
    moment_ext: Vec3, force_z_ext: jax.Array, span: DisturbanceRange
) -> list[jax.Array]:
    """Each of the four disturbances over its range; zero where the range is zero."""
    pairs = zip(
        (*moment_ext.components(), force_z_ext),
        (span.moment_x, span.moment_y, span.moment_z, span.force_z),
        strict=True,
    )
    return [jnp.where(half > 0, x / jnp.where(half > 0, half, 1.0), 0.0) for x, half in pairs]


def motor_numbers(
    c: MotorConstants,
    drone: MotorState,
    g: Gate,
    moment_ext: Vec3,
    force_z_ext: jax.Array,
    span: DisturbanceRange,
) -> list[jax.Array]:
    """The 24 numbers of the motor-level (E2E) policy.

    Args:
        c: constants whose rpm range scales the propeller speeds.
        drone: the state.
        g: the target gate.
        moment_ext: what is known of the external moment, N m, body.
        force_z_ext: () what is known of the external specific force along body z, m/s^2.
        span: the ranges that scale the two to [-1, 1]; a range of zero gives zero.
    """
    rpm = [scale_to_unit(w, c.rpm_min, c.rpm_max) for w in drone.rpm.components()]
    return (
        pose_in_gate_frame(drone, g)
        + [*drone.rates.components(), *rpm]
        + next_gate(g)
        + _scaled_disturbance(moment_ext, force_z_ext, span)
    )


def rate_numbers(c: RateConstants, drone: RateState, g: Gate) -> list[jax.Array]:
    """The 17 numbers of the rate-level (INDI) policy; ``c`` scales the thrust to [-1, 1]."""
    thrust = scale_to_unit(drone.thrust, c.thrust_min, c.thrust_max)
    return pose_in_gate_frame(drone, g) + [*drone.rates.components(), thrust] + next_gate(g)
