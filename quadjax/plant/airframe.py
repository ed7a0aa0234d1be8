"""An airframe that deviates from the model: its rotors, their axes, their wakes and its balance.

A config gives the ranges of the deviations, from which each drone is drawn. Positions of the rotors
follow from the constants: the arms are ``k_q / (m k_w)`` along body x, ``k_p / (m k_w)`` along y.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.config import AirframeConfig, RotorConfig
from quadjax.plant.effects import induced_square
from quadjax.plant.indi import PITCH, ROLL, YAW
from quadjax.vehicle.motor import MotorConstants, hover_rpm


class Airframe(struct.PyTreeNode):
    """Deviations of one drone."""

    speed_loss: jax.Array  # of the rotors' thrust, per (w^2 - w_hover^2) / rpm_max^2
    torque_curve: jax.Array  # fraction of the rotors' torque that grows with w^2 rather than w
    rotor_loss: Rotors  # fraction of its thrust that a rotor lacks at any speed
    lift_loss: jax.Array  # fraction of the model's translational lift, k_h, missing along body x
    side_lift_loss: jax.Array  # the same along body y
    wake_loss: jax.Array  # fraction of its thrust that a rotor lacks in the wake of others
    tilt_x: Rotors  # rad, of a rotor's thrust towards body x
    tilt_y: Rotors
    offset_x: jax.Array  # m, center of gravity from the middle of the rotors
    offset_y: jax.Array


def draw_airframe(config: AirframeConfig, seed: int) -> Airframe | None:
    """The airframe of a seed; None if the ranges have no deviation."""
    if config == AirframeConfig():
        return None
    random = np.random.default_rng((seed, 1))  # not the stream of the constants
    speed_loss = random.uniform(*config.speed_loss)
    rotors = random.uniform(-1.0, 1.0, 4) * config.rotor_spread
    tilt = np.deg2rad(config.tilt_deg) * random.uniform(-1.0, 1.0, (2, 4))
    lift_loss, wake_loss = random.uniform(*config.lift_loss), random.uniform(*config.wake_loss)
    side_lift_loss = random.uniform(*config.side_lift_loss)
    offset = np.array(config.offset) * random.uniform(-1.0, 1.0, 2)
    torque_curve = random.uniform(*config.torque_curve)
    return Airframe(
        speed_loss=jnp.float32(speed_loss),
        torque_curve=jnp.float32(torque_curve),
        rotor_loss=Rotors(*map(jnp.float32, rotors)),
        lift_loss=jnp.float32(lift_loss),
        side_lift_loss=jnp.float32(side_lift_loss),
        wake_loss=jnp.float32(wake_loss),
        tilt_x=Rotors(*map(jnp.float32, tilt[0])),
        tilt_y=Rotors(*map(jnp.float32, tilt[1])),
        offset_x=jnp.float32(offset[0]),
        offset_y=jnp.float32(offset[1]),
    )


def airframe_force_moment(
    airframe: Airframe,
    r: RotorConfig,
    c: MotorConstants,
    mass: jax.Array,
    rpm: Rotors,
    air_velocity: Vec3,
) -> tuple[Vec3, Vec3]:
    """What the deviations add to the nominal specific force, m/s^2, and moment, N m, body frame.

    A rotor lacks a fraction of the thrust ``k_w w^2`` of the model: a constant one; one that grows
    with the square of its speed from none at the hover, as for blades that bend; and one in the
    wake of the others, from none for the foremost to all for the rearmost rotor. The wakes reach
    the rotors behind as far as the drone's speed sweeps them back, ``V^2 / (V^2 + v_i^2)`` with the
    induced velocity of the hover (Leishman, "Principles of helicopter aerodynamics", 2006, section
    2.14). Translational lift, ``k_h``, differs along the body's axes. The torque of a propeller
    grows with the square of its speed (the same, section 2.2), that of the model linearly; both are
    equal at the hover. Rotors whose axes are not parallel pull to the sides and turn the drone;
    with a center of gravity off the middle, the arms of some rotors are shorter.

    Args:
        airframe: of the drone.
        r: of the rotors.
        c: of the drone.
        mass: () kg.
        rpm: propeller speeds, rpm.
        air_velocity: m/s, body.
    """
    vx, vy = air_velocity.x, air_velocity.y
    square = vx * vx + vy * vy
    speed = jnp.sqrt(square + 1.0e-6)
    swept = square / (square + induced_square(r, c, mass))
    force, moment = Vec3.zero(), Vec3.zero()
    hover = hover_rpm(c)
    arm_x, arm_y = c.k_q / (mass * c.k_w), c.k_p / (mass * c.k_w)
    reach = jnp.sqrt(arm_x * arm_x + arm_y * arm_y)
    torque = airframe.torque_curve * c.k_r1 / mass
    for i, w in enumerate(rpm.components()):
        thrust = c.k_w * w * w
        x, y = PITCH[i] * arm_x, -ROLL[i] * arm_y
        behind = 0.5 * (1.0 - (x * vx + y * vy) / (reach * speed))  # 0 foremost, 1 rearmost
        faster = (w - hover) * (w + hover) / (c.rpm_max * c.rpm_max)
        lost = airframe.rotor_loss[i] + airframe.speed_loss * faster
        lost = lost + airframe.wake_loss * swept * behind
        pull = Vec3(thrust * airframe.tilt_x[i], thrust * airframe.tilt_y[i], thrust * lost)
        force = force + pull
        x, y = x - airframe.offset_x, y - airframe.offset_y
        moment = moment + Vec3(
            y * pull.z + airframe.offset_y * thrust,
            -x * pull.z - airframe.offset_x * thrust,
            x * pull.y - y * pull.x + YAW[i] * torque * w * (w / hover - 1.0),
        )
    lift = c.k_h * (airframe.lift_loss * vx * vx + airframe.side_lift_loss * vy * vy)
    return force.replace(z=force.z + lift), moment * mass
