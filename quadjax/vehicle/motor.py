"""The motor-level (E2E) model: four rpm commands in, rigid-body flight out.

Equations and constants: Ferede et al., arXiv 2311.16948 and 2304.13460. World NED, body FRD.
Motors: 1 front-left, 2 front-right, 3 rear-right, 4 rear-left; 2 and 4 spin counter-clockwise
seen from above.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.frames import attitude, body_to_world, euler_rates, world_to_body
from quadjax.core.materialize import Caller, call_directly
from quadjax.core.vectors import Rotors, Vec3, between
from quadjax.vehicle.constants import MotorConstants
from quadjax.vehicle.protocol import Measurement, Motion, Signal, VehicleModel, VehicleParams
from quadjax.vehicle.residual import residual_force_moment


@struct.dataclass
class MotorState:
    """State of one drone."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    euler: Vec3  # roll, pitch, yaw, rad
    rates: Vec3  # p, q, r, rad/s, body
    rpm: Rotors  # propeller speeds, rpm
    moment_ext: Vec3  # external moment, N m, body
    force_ext: Vec3  # external specific force, m/s^2, body


def nominal_force(c: MotorConstants, rpm: Rotors, body_velocity: Vec3) -> Vec3:
    """Nominal specific force, m/s^2, body frame, of propeller speeds, rpm, and velocity, m/s.

    Plain arithmetic, so that it serves NumPy float64 arrays (n,) as well as traced scalars; it is
    linear in the constants.
    """
    vx, vy, vz = body_velocity.x, body_velocity.y, body_velocity.z
    sum_rpm = rpm.w1 + rpm.w2 + rpm.w3 + rpm.w4
    sum_squares = rpm.w1 * rpm.w1 + rpm.w2 * rpm.w2 + rpm.w3 * rpm.w3 + rpm.w4 * rpm.w4
    return Vec3(
        -c.k_x * vx * sum_rpm,
        -c.k_y * vy * sum_rpm,
        -c.k_w * sum_squares - c.k_z * vz * sum_rpm - c.k_h * (vx * vx + vy * vy),
    )


def nominal_moment(
    c: MotorConstants, rpm: Rotors, rpm_rate: Rotors, body_velocity: Vec3, body_rates: Vec3
) -> Vec3:
    """Nominal moment, N m, body frame; for NumPy arrays and linear as ``nominal_force``.

    Args:
        c: the constants.
        rpm: propeller speeds, rpm.
        rpm_rate: their derivatives, rpm/s.
        body_velocity: m/s.
        body_rates: rad/s.
    """
    s1, s2, s3, s4 = (rpm * rpm).components()
    imbalance = -rpm.w1 + rpm.w2 - rpm.w3 + rpm.w4
    acceleration = -rpm_rate.w1 + rpm_rate.w2 - rpm_rate.w3 + rpm_rate.w4
    return Vec3(
        c.k_p * (s1 - s2 - s3 + s4) + c.k_pv * body_velocity.y,
        c.k_q * (s1 + s2 - s3 - s4) + c.k_qv * body_velocity.x,
        c.k_r1 * imbalance + c.k_r2 * acceleration - c.k_rr * body_rates.z,
    )


def force_moment(
    params: VehicleParams, rpm: Rotors, rpm_rate: Rotors, body_velocity: Vec3, body_rates: Vec3
) -> tuple[Vec3, Vec3]:
    """Specific force, m/s^2, and moment, N m, body frame, with the residual if there is one."""
    force = nominal_force(params.constants, rpm, body_velocity)
    moment = nominal_moment(params.constants, rpm, rpm_rate, body_velocity, body_rates)
    if params.residual is not None:
        extra_force_z, extra_moment = residual_force_moment(
            params.residual, rpm, body_velocity, body_rates
        )
        force = force.replace(z=force.z + extra_force_z)
        moment = moment + extra_moment
    return force, moment


def angular_acceleration(c: MotorConstants, moment: Vec3, rates: Vec3) -> Vec3:
    """``I^-1 (M - Omega x I Omega)``, rad/s^2, body frame, of a moment, N m, and rates, rad/s."""
    p, q, r = rates.x, rates.y, rates.z
    return Vec3(
        (moment.x + (c.i_yy - c.i_zz) * q * r) / c.i_xx,
        (moment.y + (c.i_zz - c.i_xx) * r * p) / c.i_yy,
        (moment.z + (c.i_xx - c.i_yy) * p * q) / c.i_zz,
    )


def derivative(
    params: VehicleParams, state: MotorState, rpm_command: Rotors, call: Caller = call_directly
) -> MotorState:
    """Time derivative of the state under four rpm commands, as a ``MotorState``.

    ``call`` calls a function and materializes its values.
    """
    c = params.constants
    a = call(attitude, state.euler)
    body_velocity = call(world_to_body, a, state.velocity)
    rpm_rate = (rpm_command - state.rpm) / c.tau
    force, moment = force_moment(params, state.rpm, rpm_rate, body_velocity, state.rates)
    acceleration = body_to_world(a, force + state.force_ext)
    return MotorState(
        position=state.velocity,
        velocity=acceleration.replace(z=acceleration.z + c.g),
        euler=euler_rates(a, state.rates),
        rates=angular_acceleration(c, moment + state.moment_ext, state.rates),
        rpm=rpm_rate,
        moment_ext=Vec3.zero(),
        force_ext=Vec3.zero(),
    )


def command_range(c: MotorConstants) -> tuple[Rotors, Rotors]:
    """Lowest and highest command, rpm."""
    return Rotors.same(c.rpm_min), Rotors.same(c.rpm_max)


def hover_rpm(c: MotorConstants) -> jax.Array:
    """Propeller speed () at which four rotors carry the drone at rest, rpm."""
    return jnp.sqrt(c.g / (4.0 * c.k_w))


def specific_force(params: VehicleParams, state: MotorState) -> Vec3:
    """What an ideal accelerometer measures, m/s^2, body frame."""
    velocity = world_to_body(attitude(state.euler), state.velocity)
    steady = Rotors.same(jnp.zeros(()))  # forces do not depend on the propellers' acceleration
    force, _ = force_moment(params, state.rpm, steady, velocity, state.rates)
    return force + state.force_ext


def balance(params: VehicleParams, measured: Measurement) -> tuple[Vec3, Vec3, Vec3]:
    """The terms that the disturbance estimator compares; see ``VehicleModel.balance``.

    Returns:
        Angular momentum minus the part that rotor acceleration exchanges with the body, N m s;
        gyroscopic minus modeled moment, N m; measured minus modeled specific force, m/s^2.
    """
    c, rpm, rates = params.constants, measured.rpm, measured.gyro
    rotors = c.k_r2 * (-rpm.w1 + rpm.w2 - rpm.w3 + rpm.w4)
    momentum = Vec3(c.i_xx * rates.x, c.i_yy * rates.y, c.i_zz * rates.z - rotors)
    p, q, r = rates.x, rates.y, rates.z
    gyroscopic = Vec3(
        (c.i_zz - c.i_yy) * q * r, (c.i_xx - c.i_zz) * r * p, (c.i_yy - c.i_xx) * p * q
    )
    # The moment of rotor acceleration is differentiated by the filter, not here.
    steady = jax.tree.map(jnp.zeros_like, rpm)
    force, moment = force_moment(params, rpm, steady, measured.body_velocity, rates)
    return momentum, gyroscopic - moment, measured.specific_force - force


def start(
    c: MotorConstants, motion: Motion, drawn: jax.Array, thrust: tuple[jax.Array, jax.Array]
) -> MotorState:
    """A start with propeller speeds drawn over their range, of numbers (4..,) in [-1, 1]."""
    rpm = Rotors.of(between(c.rpm_min, c.rpm_max, drawn[:4]))
    return _undisturbed(motion, rpm)


def hover(c: MotorConstants, motion: Motion) -> MotorState:
    """A start with the propeller speeds of a hover, clipped to the range of the motors."""
    rpm = Rotors.same(jnp.clip(hover_rpm(c), c.rpm_min, c.rpm_max))
    return _undisturbed(motion, rpm)


def _undisturbed(motion: Motion, rpm: Rotors) -> MotorState:
    return MotorState(**vars(motion), rpm=rpm, moment_ext=Vec3.zero(), force_ext=Vec3.zero())


def _with_disturbance(state: MotorState, moment: Vec3, force: Vec3) -> MotorState:
    return state.replace(moment_ext=moment, force_ext=force)


MODEL = VehicleModel(
    name="motor",
    constants=MotorConstants,
    commands=(Signal("rpm", 4, "rpm"),),
    actuators=Signal("rpm", 4, "rpm"),
    derivative=derivative,
    command_range=command_range,
    actuator_range=command_range,
    actuator_state=lambda state: state.rpm,
    start=start,
    hover=hover,
    specific_force=specific_force,
    groups={
        "gravity": ("g",),
        "inertia": ("i_xx", "i_yy", "i_zz"),
        "thrust": ("k_w",),
        "drag": ("k_x", "k_y", "k_z", "k_h"),
        "moment": ("k_p", "k_q"),
        "velocity_moment": ("k_pv", "k_qv"),
        "yaw": ("k_r1", "k_r2", "k_rr"),
        "lag": ("tau",),
        "limits": ("rpm_min", "rpm_max"),
    },
    positive=("g", "i_xx", "i_yy", "i_zz", "k_w", "k_p", "k_q", "k_r1", "tau"),
    nonnegative=("k_x", "k_y", "k_r2"),
    ranges=(("rpm_min", "rpm_max"),),
    lags=("tau",),
    thrust_to_weight=lambda c: 4.0 * c["k_w"] * c["rpm_max"] ** 2 / c["g"],
    has_battery=True,
    has_residual=True,
    disturbance=lambda state: (state.moment_ext, state.force_ext),
    with_disturbance=_with_disturbance,
    balance=balance,
)
