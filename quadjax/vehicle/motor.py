"""The motor-level (E2E) model: four rpm commands in, rigid-body flight out.

Equations and constants: Ferede et al., arXiv 2311.16948 and 2304.13460. World NED, body FRD.
Motors: 1 front-left, 2 front-right, 3 rear-right, 4 rear-left; 2 and 4 spin counter-clockwise
seen from above.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle.constants import constant
from quadjax.vehicle.protocol import Signal, VehicleModel, VehicleParams
from quadjax.vehicle.residual import residual_force_moment
from quadjax.vehicle.rigid_body import BodyState


class MotorConstants(struct.PyTreeNode):
    """Constants of the model ``motor``; those of the Bebop 1 are in its vehicle file."""

    g: jax.Array = constant("m/s^2", "gravity", "positive")
    i_xx: jax.Array = constant("kg m^2", "inertia", "positive")
    i_yy: jax.Array = constant("kg m^2", "inertia", "positive")
    i_zz: jax.Array = constant("kg m^2", "inertia", "positive")
    k_x: jax.Array = constant("1/(s rpm)", "drag", "nonnegative")  # rotor drag
    k_y: jax.Array = constant("1/(s rpm)", "drag", "nonnegative")
    k_z: jax.Array = constant("1/(s rpm)", "drag")
    k_w: jax.Array = constant("m/s^2/rpm^2", "thrust", "positive")
    k_h: jax.Array = constant("1/m", "drag")  # translational lift
    k_p: jax.Array = constant("N m/rpm^2", "moment", "positive")  # roll
    k_q: jax.Array = constant("N m/rpm^2", "moment", "positive")  # pitch
    k_pv: jax.Array = constant("N s", "velocity_moment")  # roll moment of sideways flight
    k_qv: jax.Array = constant("N s", "velocity_moment")  # pitch moment of forward flight
    k_r1: jax.Array = constant("N m/rpm", "yaw", "positive")  # rotor drag
    k_r2: jax.Array = constant("N m s/rpm", "yaw", "nonnegative")  # rotor acceleration
    k_rr: jax.Array = constant("N m s", "yaw")  # yaw damping
    tau: jax.Array = constant("s", "lag", "positive")  # of the motors
    rpm_min: jax.Array = constant("rpm", "limits")
    rpm_max: jax.Array = constant("rpm", "limits", above="rpm_min")


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

    Of propeller speeds, rpm, their derivatives, rpm/s, velocity, m/s, and body rates, rad/s.
    """
    s1, s2, s3, s4 = (rpm * rpm).components()
    imbalance = -rpm.w1 + rpm.w2 - rpm.w3 + rpm.w4
    acceleration = -rpm_rate.w1 + rpm_rate.w2 - rpm_rate.w3 + rpm_rate.w4
    return Vec3(
        c.k_p * (s1 - s2 - s3 + s4) + c.k_pv * body_velocity.y,
        c.k_q * (s1 + s2 - s3 - s4) + c.k_qv * body_velocity.x,
        c.k_r1 * imbalance + c.k_r2 * acceleration - c.k_rr * body_rates.z,
    )


def angular_acceleration(c: MotorConstants, moment: Vec3, rates: Vec3) -> Vec3:
    """``I^-1 (M - Omega x I Omega)``, rad/s^2, body frame, of a moment, N m, and rates, rad/s."""
    p, q, r = rates.x, rates.y, rates.z
    return Vec3(
        (moment.x + (c.i_yy - c.i_zz) * q * r) / c.i_xx,
        (moment.y + (c.i_zz - c.i_xx) * r * p) / c.i_yy,
        (moment.z + (c.i_xx - c.i_yy) * p * q) / c.i_zz,
    )


def gyroscopic_moment(c: MotorConstants, rates: Vec3) -> Vec3:
    """``Omega x I Omega``, N m, body frame, of rates, rad/s."""
    p, q, r = rates.x, rates.y, rates.z
    return Vec3((c.i_zz - c.i_yy) * q * r, (c.i_xx - c.i_zz) * r * p, (c.i_yy - c.i_xx) * p * q)


def hover_rpm(c: MotorConstants) -> jax.Array:
    """Propeller speed () at which four rotors carry the drone at rest, rpm."""
    return jnp.sqrt(c.g / (4.0 * c.k_w))


class Motor(VehicleModel):
    """The model ``motor``: four motor speeds, rpm, as commands.

    With propeller speeds ``w``, rpm, and body velocity ``v``, the specific force, m/s^2, and the
    moment, N m, are

    ```text
    Fx = -k_x vx sum(w)          Mx = k_p ( w1^2 - w2^2 - w3^2 + w4^2) + k_pv vy
    Fy = -k_y vy sum(w)          My = k_q ( w1^2 + w2^2 - w3^2 - w4^2) + k_qv vx
    Fz = -k_w sum(w^2)           Mz = k_r1 (-w1 + w2 - w3 + w4)
         - k_z vz sum(w)              + k_r2 (-w1' + w2' - w3' + w4') - k_rr r
         - k_h (vx^2 + vy^2)     w' = (command - w) / tau
    ```
    """

    name = "motor"
    constants = MotorConstants
    commands = (Signal("rpm", 4, "rpm"),)
    actuators = Signal("rpm", 4, "rpm")
    has_battery = has_residual = can_be_disturbed = True

    def actuator_rate(self, c: MotorConstants, actuators: Rotors, command: Rotors) -> Rotors:
        """Derivatives of the propeller speeds, rpm/s."""
        return (command - actuators) / c.tau

    def force_moment(self, params: VehicleParams, body: BodyState) -> tuple[Vec3, Vec3]:
        """Specific force, m/s^2, and moment, N m, with the residual if there is one."""
        c, rpm, velocity, rates = params.constants, body.actuators, body.velocity, body.rates
        force = nominal_force(c, rpm, velocity)
        moment = nominal_moment(c, rpm, body.actuator_rate, velocity, rates)
        if params.residual is None:
            return force, moment
        extra_z, extra_moment = residual_force_moment(params.residual, rpm, velocity, rates)
        return force.replace(z=force.z + extra_z), moment + extra_moment

    def angular_acceleration(
        self, c: MotorConstants, moment: Vec3, rates: Vec3, command: Rotors
    ) -> Vec3:
        """The derivative of the body rates, rad/s^2, of a moment, N m."""
        return angular_acceleration(c, moment, rates)

    def angular_momentum(
        self, c: MotorConstants, actuators: Rotors, rates: Vec3
    ) -> tuple[Vec3, Vec3]:
        """Angular momentum minus that of the rotors, N m s, and the gyroscopic moment, N m."""
        rpm = actuators
        rotors = c.k_r2 * (-rpm.w1 + rpm.w2 - rpm.w3 + rpm.w4)
        momentum = Vec3(c.i_xx * rates.x, c.i_yy * rates.y, c.i_zz * rates.z - rotors)
        return momentum, gyroscopic_moment(c, rates)

    def command_range(self, c: MotorConstants) -> tuple[Rotors, Rotors]:
        """Lowest and highest command, rpm."""
        return Rotors.same(c.rpm_min), Rotors.same(c.rpm_max)

    def hover_actuators(self, c: MotorConstants) -> Rotors:
        """Propeller speeds of a hover, rpm, clipped to the range of the motors."""
        return Rotors.same(jnp.clip(hover_rpm(c), c.rpm_min, c.rpm_max))

    def thrust_to_weight(self, c: MotorConstants) -> jax.Array:
        """Thrust at the highest command over weight."""
        return 4.0 * c.k_w * c.rpm_max**2 / c.g


# Disturbed in every race, also without a section ``disturbance``: its observation has them.
MODEL = Motor(disturbed=True)
