"""Effects of air and rotors that the training model lacks.

Each function returns an *addition* to the nominal force or moment, or to a state's derivative, at
full strength. World NED, body FRD; forces are specific.
"""

import functools
import operator
from collections.abc import Sequence

import jax
import jax.numpy as jnp

from quadjax.core.gradients import Scalar
from quadjax.core.vectors import Rotors, Vec3, cross
from quadjax.plant.config import ImuConfig, RotorConfig
from quadjax.vehicle.airframe import AIR_DENSITY, RPM_PER_RAD_S
from quadjax.vehicle.motor import MotorConstants

GROUND_DISCS = 4.0  # rotors close together, which act as one disc of their area
LOCK_NUMBER = 3.0  # aerodynamic / inertial moment of a blade; assumed
HUB_STIFFNESS = 0.03  # N m/rad, all hubs together; assumed
GYRO_VIBRATION = 0.01  # rad/s, amplitude of one rotor in the gyro at its hover speed; assumed
_NEAREST = 0.5  # rotor radii: least height of a disc above the ground in its effect
_LEAST_RPM = 500.0  # least speed of a disc in flapping


def advance_loss(r: RotorConfig, c: MotorConstants, air_velocity: Vec3) -> jax.Array:
    """Specific force () along body z, m/s^2, lost in a climb.

    The thrust coefficient of a propeller falls faster than linearly with its advance ratio
    ``J = V / (n D)`` (measured curves: Brandt and Selig, "Propeller performance data at low
    Reynolds numbers", AIAA 2011-1255). The nominal model has the linear part, ``k_z``; this is
    the rest, ``C_T = C_T0 (1 - c J^2)`` with ``V`` the climb along the rotors' axis: of four rotors
    ``4 k_w c (60 V / D)^2``, whatever their speed. Nothing in a descent.
    """
    climb = jnp.maximum(-air_velocity.z, 0.0)
    turns = 30.0 * climb / r.radius  # V / D in turns a minute, D = 2 R
    return 4.0 * c.k_w * r.advance_loss * turns * turns


def ground_gain(
    r: RotorConfig,
    c: MotorConstants,
    mass: jax.Array,
    rpm: Rotors,
    air_velocity: Vec3,
    altitude: jax.Array,
) -> jax.Array:
    """Specific force () along body z, m/s^2, due to the ground; negative: upwards.

    Cheeseman and Bennett, "The effect of the ground on a helicopter rotor in forward flight",
    ARC R&M 3021, 1955: ``T / T_free = 1 / (1 - (R / 4 h)^2 / (1 + (V / v_i)^2))`` with the height
    ``h`` of the disc, the horizontal speed ``V`` and the induced velocity of the hover ``v_i =
    sqrt(T / (2 rho A))`` (Leishman, "Principles of helicopter aerodynamics", 2006, equation 2.15).

    Args:
        r: of the rotors.
        c: of the drone.
        mass: () kg.
        rpm: propeller speeds, rpm.
        air_velocity: m/s, body.
        altitude: () of the center of gravity above the ground, m.
    """
    height = jnp.maximum(altitude + r.height, _NEAREST * r.radius)
    ratio = r.radius / (4.0 * height)
    square = air_velocity.x * air_velocity.x + air_velocity.y * air_velocity.y
    near = GROUND_DISCS * ratio * ratio / (1.0 + square / induced_square(r, c, mass))
    near = jnp.minimum(near, 0.5)
    s = rpm * rpm
    return -c.k_w * (s.w1 + s.w2 + s.w3 + s.w4) * (near / (1.0 - near))


def induced_square(r: RotorConfig, c: MotorConstants, mass: jax.Array) -> jax.Array:
    """Square of the induced velocity of the hover (), m^2/s^2; mass in kg."""
    return mass * c.g / (8.0 * AIR_DENSITY * jnp.pi * r.radius * r.radius)


def flapping_moment(
    r: RotorConfig, c: MotorConstants, mass: jax.Array, rpm: Rotors, air_velocity: Vec3, rates: Vec3
) -> Vec3:
    """Moment, N m, body, of discs that tilt with the flow and lag the body's rotation.

    Mahony, Kumar and Corke, "Multirotor aerial vehicles", IEEE Robotics and Automation Magazine
    19(3), 2012, and Hoffmann, Huang, Waslander and Tomlin, AIAA 2007-6461: a disc tilts away from
    the flow by ``a V / (omega R)`` and, on a body that turns at ``q``, lags by
    ``16 q / (gamma omega)``; the tilt acts through the thrust at the discs' height and through the
    stiffness of the hubs.

    Arguments as of ``ground_gain``, and the body rates, rad/s.
    """
    s = rpm * rpm
    newtons = mass * c.k_w * (s.w1 + s.w2 + s.w3 + s.w4)
    mean = jnp.maximum(0.25 * (rpm.w1 + rpm.w2 + rpm.w3 + rpm.w4), _LEAST_RPM) / RPM_PER_RAD_S
    arm = r.height * newtons + HUB_STIFFNESS
    per_speed = r.flap_gain / (mean * r.radius)
    per_rate = 16.0 / (LOCK_NUMBER * mean)
    roll = -arm * (per_speed * air_velocity.y + per_rate * rates.x)
    pitch = arm * (per_speed * air_velocity.x - per_rate * rates.y)
    return Vec3(roll, pitch, jnp.zeros_like(roll))


def gyroscopic_moment(c: MotorConstants, rpm: Rotors, rates: Vec3) -> Vec3:
    """Moment, N m, body, of rotors whose axes turn with the body: ``-Omega x h``.

    Greenwood, "Principles of dynamics", 1988, chapter 8. The angular momentum ``h`` along body z is
    the one whose change is the nominal model's reaction ``k_r2 omega'``: rotors 1 and 3 turn about
    body z, 2 and 4 against it.
    """
    momentum = c.k_r2 * (rpm.w1 - rpm.w2 + rpm.w3 - rpm.w4)
    return Vec3(-rates.y * momentum, rates.x * momentum, jnp.zeros_like(momentum))


def lever_acceleration(imu: ImuConfig, rates: Vec3, turning: Vec3) -> Vec3:
    """Acceleration, m/s^2, of the unit relative to the center of gravity, body.

    ``alpha x r + Omega x (Omega x r)`` of a rigid body, with rates, rad/s, and angular acceleration
    ``turning``, rad/s^2.
    """
    offset = Vec3(*map(jnp.asarray, imu.offset))
    return cross(turning, offset) + cross(rates, cross(rates, offset))


def vibration(imu: ImuConfig, hover: jax.Array, rpm: Rotors, phase: Rotors) -> tuple[Vec3, Vec3]:
    """Specific force, m/s^2, and rates, rad/s, at the unit, of rotors out of balance.

    An imbalance pulls with the square of the rotor's speed in a direction that turns with the
    rotor: two components across the rotor's axis, and one along it from the frame's response.

    Args:
        imu: the unit.
        hover: () propeller speed at which it has its amplitude, rpm.
        rpm: propeller speeds, rpm.
        phase: angles of the rotors, rad.
    """
    size = rpm * rpm * (1.0 / (hover * hover))
    along, across = Vec3.zero(), Vec3.zero()
    for weight, angle in zip(size.components(), phase.components(), strict=True):
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        along = along + Vec3(cosine, sine, sine) * weight
        across = across + Vec3(sine, -cosine, cosine) * weight
    return along * imu.vibration, across * GYRO_VIBRATION


def rotor_rates(
    tau: Scalar, slowing: Scalar, lag: Scalar, rpm: Rotors, rpm_rate: Rotors, target: Rotors
) -> tuple[Rotors, Rotors]:
    """First and second derivative of the propeller speeds, rpm/s and rpm/s^2.

    ``tau lag omega'' + tau omega' + omega = u``: the electrical time constant of a brushless motor
    or its controller before the mechanical one (Franklin, Powell and Emami-Naeini, "Feedback
    control of dynamic systems", section 2.3). The measured speeds of the published flights deviate
    from the first-order model as well (Ferede et al., arXiv 2311.16948, figure of commanded,
    modeled and measured rpm): they rise later and do not reach the ends of the range.

    Args:
        tau: () s, the first time constant.
        slowing: () factor on it while the target is below the speed. A controller drives a motor
            in speeding up, air and friction slow it down.
        lag: () s, the second one; 0: first order.
        rpm: propeller speeds, rpm.
        rpm_rate: their derivatives, of second-order motors, rpm/s.
        target: the steady speeds ``u`` of a command, rpm.
    """
    second_order = lag > 0.0
    lags = jax.tree.map(lambda u, w: jnp.where(u < w, tau * slowing, tau), target, rpm)
    first = (target - rpm) / lags
    bend = (first - rpm_rate) / jnp.where(second_order, lag, 1.0)
    return (
        jax.tree.map(lambda a, b: jnp.where(second_order, a, b), rpm_rate, first),
        jax.tree.map(lambda x: jnp.where(second_order, x, 0.0), bend),
    )


def steady_speeds(command: Rotors, shortfall: Scalar, hover: Scalar, top: Scalar) -> Rotors:
    """Steady propeller speeds of a command, rpm, at most ``top``.

    Args:
        command: rpm.
        shortfall: () fraction of its distance to ``hover``, rpm, that is not reached.
        hover: () rpm.
        top: () highest reachable speed, rpm.
    """
    reached = command - (command - hover) * shortfall
    return jax.tree.map(lambda u: jnp.minimum(u, top), reached)


def delayed(line: Sequence[Rotors], delay: jax.Array) -> Rotors:
    """The command of ``delay`` () samples ago, between two samples as on the line between them.

    The last of ``line`` is that of now.
    """
    weights = (jnp.maximum(1.0 - jnp.abs(age - delay), 0.0) for age in range(len(line)))
    parts = [u * weight for u, weight in zip(reversed(line), weights, strict=True)]
    return functools.reduce(operator.add, parts)
