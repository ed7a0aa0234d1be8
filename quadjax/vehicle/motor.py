"""The motor-level (E2E) model: four rpm commands in, rigid-body flight out.

Equations and constants: Ferede et al., arXiv 2311.16948 and 2304.13460. World NED, body FRD.
Motors: 1 front-left, 2 front-right, 3 rear-right, 4 rear-left; 2 and 4 spin counter-clockwise
seen from above.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.vehicle.constants import MotorConstants
from quadjax.vehicle.frames import attitude, body_to_world, euler_rates, world_to_body
from quadjax.vehicle.residual import Residual, residual_force_moment


@struct.dataclass
class MotorState:
    """State of one drone."""

    position: jax.Array  # (3,) m, world
    velocity: jax.Array  # (3,) m/s, world
    euler: jax.Array  # (3,) roll, pitch, yaw, rad
    rates: jax.Array  # (3,) p, q, r, rad/s, body
    rpm: jax.Array  # (4,) propeller speeds, rpm
    moment_ext: jax.Array  # (3,) external moment, N m, body
    force_ext: jax.Array  # (3,) external specific force, m/s^2, body


@struct.dataclass
class MotorParams:
    """What the motor-level model is computed with: all of it traced."""

    constants: MotorConstants
    residual: Residual | None = None


def nominal_force(c: MotorConstants, rpm: jax.Array, body_velocity: jax.Array) -> jax.Array:
    """Nominal specific force (3,), m/s^2, body frame, of rpm (4,) and body velocity (3,), m/s."""
    vx, vy, vz = body_velocity[0], body_velocity[1], body_velocity[2]
    sum_rpm = rpm[0] + rpm[1] + rpm[2] + rpm[3]
    sum_squares = rpm[0] ** 2 + rpm[1] ** 2 + rpm[2] ** 2 + rpm[3] ** 2
    return jnp.stack(
        [
            -c.k_x * vx * sum_rpm,
            -c.k_y * vy * sum_rpm,
            -c.k_w * sum_squares - c.k_z * vz * sum_rpm - c.k_h * (vx * vx + vy * vy),
        ]
    )


def nominal_moment(
    c: MotorConstants,
    rpm: jax.Array,
    rpm_rate: jax.Array,
    body_velocity: jax.Array,
    body_rates: jax.Array,
) -> jax.Array:
    """Nominal moment (3,), N m, body frame.

    Args:
        c: the constants.
        rpm: propeller speeds (4,), rpm.
        rpm_rate: their derivatives (4,), rpm/s.
        body_velocity: (3,), m/s.
        body_rates: (3,), rad/s.
    """
    w1, w2, w3, w4 = rpm[0], rpm[1], rpm[2], rpm[3]
    s1, s2, s3, s4 = w1 * w1, w2 * w2, w3 * w3, w4 * w4
    acceleration = -rpm_rate[0] + rpm_rate[1] - rpm_rate[2] + rpm_rate[3]
    return jnp.stack(
        [
            c.k_p * (s1 - s2 - s3 + s4) + c.k_pv * body_velocity[1],
            c.k_q * (s1 + s2 - s3 - s4) + c.k_qv * body_velocity[0],
            c.k_r1 * (-w1 + w2 - w3 + w4) + c.k_r2 * acceleration - c.k_rr * body_rates[2],
        ]
    )


def force_moment(
    params: MotorParams,
    rpm: jax.Array,
    rpm_rate: jax.Array,
    body_velocity: jax.Array,
    body_rates: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """Specific force (3,), m/s^2, and moment (3,), N m, body frame, with the residual if any."""
    force = nominal_force(params.constants, rpm, body_velocity)
    moment = nominal_moment(params.constants, rpm, rpm_rate, body_velocity, body_rates)
    if params.residual is not None:
        extra_force_z, extra_moment = residual_force_moment(
            params.residual, rpm, body_velocity, body_rates
        )
        force = jnp.stack([force[0], force[1], force[2] + extra_force_z])
        moment = moment + extra_moment
    return force, moment


def derivative(params: MotorParams, state: MotorState, rpm_command: jax.Array) -> MotorState:
    """Time derivative of the state under four rpm commands (4,), as a ``MotorState``."""
    c = params.constants
    a = attitude(state.euler)
    body_velocity = world_to_body(a, state.velocity)
    rpm_rate = (rpm_command - state.rpm) / c.tau
    force, moment = force_moment(params, state.rpm, rpm_rate, body_velocity, state.rates)
    acceleration = body_to_world(a, force + state.force_ext)
    p, q, r = state.rates[0], state.rates[1], state.rates[2]
    total = moment + state.moment_ext
    return MotorState(
        position=state.velocity,
        velocity=jnp.stack([acceleration[0], acceleration[1], acceleration[2] + c.g]),
        euler=euler_rates(a, state.rates),
        rates=jnp.stack(
            [
                (total[0] + (c.i_yy - c.i_zz) * q * r) / c.i_xx,
                (total[1] + (c.i_zz - c.i_xx) * r * p) / c.i_yy,
                (total[2] + (c.i_xx - c.i_yy) * p * q) / c.i_zz,
            ]
        ),
        rpm=rpm_rate,
        moment_ext=jnp.zeros_like(state.moment_ext),
        force_ext=jnp.zeros_like(state.force_ext),
    )


def command_range(c: MotorConstants) -> tuple[jax.Array, jax.Array]:
    """Lowest and highest command, each (4,), rpm."""
    return jnp.stack([jnp.asarray(c.rpm_min)] * 4), jnp.stack([jnp.asarray(c.rpm_max)] * 4)


def hover_rpm(c: MotorConstants) -> jax.Array:
    """Propeller speed () at which four rotors carry the drone at rest, rpm."""
    return jnp.sqrt(c.g / (4.0 * c.k_w))
