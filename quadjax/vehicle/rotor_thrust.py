"""Rotor thrusts as commands, without lag or drag: the drone of time-optimal planning.

Foehn, Romero, Scaramuzza, "Time-optimal planning for quadrotor waypoint flight" (Science Robotics,
2021). Rotors: 1 front-left, 2 front-right, 3 rear-right, 4 rear-left. World NED, body FRD.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle.constants import constant
from quadjax.vehicle.motor import angular_acceleration
from quadjax.vehicle.protocol import Signal, VehicleModel, VehicleParams
from quadjax.vehicle.rigid_body import BodyState, RigidBodyState


class RotorThrustConstants(struct.PyTreeNode):
    """Constants of the model ``rotor_thrust``."""

    g: jax.Array = constant("m/s^2", "gravity", "positive")
    mass: jax.Array = constant("kg", "thrust", "positive")
    i_xx: jax.Array = constant("kg m^2", "inertia", "positive")
    i_yy: jax.Array = constant("kg m^2", "inertia", "positive")
    i_zz: jax.Array = constant("kg m^2", "inertia", "positive")
    arm_x: jax.Array = constant("m", "moment", "positive")  # rotor to pitch axis
    arm_y: jax.Array = constant("m", "moment", "positive")  # rotor to roll axis
    k_torque: jax.Array = constant("m", "yaw", "positive")  # torque per thrust
    turning: Rotors = constant()  # 1: counter-clockwise seen from above, -1: clockwise
    thrust_min: jax.Array = constant("N", "limits")  # of one rotor
    thrust_max: jax.Array = constant("N", "limits", above="thrust_min")


class RotorThrust(VehicleModel):
    """The model ``rotor_thrust``; its actuators are the commanded thrusts, N."""

    name = "rotor_thrust"
    constants = RotorThrustConstants
    commands = (Signal("rotor_thrust", 4, "N"),)
    actuators = Signal("rotor_thrust", 4, "N")
    can_be_disturbed = True
    moment_unit = "rad/s^2"

    def hold(self, state: RigidBodyState, command: Rotors) -> RigidBodyState:
        """The state with the commanded thrusts."""
        return state.replace(actuators=command)

    def actuator_rate(self, c: RotorThrustConstants, actuators: Rotors, command: Rotors) -> Rotors:
        """Zero: the thrusts follow the command without a lag."""
        return Rotors.same(jnp.zeros_like(actuators.w1))

    def force_moment(self, params: VehicleParams, body: BodyState) -> tuple[Vec3, Vec3]:
        """Specific force, m/s^2, and angular acceleration, rad/s^2."""
        c, zero = params.constants, jnp.zeros_like(body.actuators.w1)
        t1, t2, t3, t4 = body.actuators.components()
        torque = c.turning * body.actuators
        moment = Vec3(
            c.arm_y * (t1 - t2 - t3 + t4),
            c.arm_x * (t1 + t2 - t3 - t4),
            c.k_torque * sum(torque.components()),
        )
        force = Vec3(zero, zero, -(t1 + t2 + t3 + t4) / c.mass)
        return force, angular_acceleration(c, moment, body.rates)

    def command_range(self, c: RotorThrustConstants) -> tuple[Rotors, Rotors]:
        """Lowest and highest thrust of each rotor, N."""
        return Rotors.same(c.thrust_min), Rotors.same(c.thrust_max)

    def hover_actuators(self, c: RotorThrustConstants) -> Rotors:
        """Thrusts of a hover, N, clipped to their range."""
        return Rotors.same(jnp.clip(0.25 * c.mass * c.g, c.thrust_min, c.thrust_max))

    def thrust_to_weight(self, c: RotorThrustConstants) -> jax.Array:
        """Thrust at the highest command over weight."""
        return 4.0 * c.thrust_max / (c.mass * c.g)


MODEL = RotorThrust(quaternion=True)
