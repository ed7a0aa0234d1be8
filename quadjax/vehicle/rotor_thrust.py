"""Rotor thrusts as commands, without lag or drag: the drone of time-optimal planning.

Foehn, Romero, Scaramuzza, "Time-optimal planning for quadrotor waypoint flight" (Science Robotics,
2021). Rotors: 1 front-left, 2 front-right, 3 rear-right, 4 rear-left. World NED, body FRD.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle.protocol import Signal
from quadjax.vehicle.rigid_body import RigidBodyState, per_rotor, rigid_body_model

Scalar = jax.Array | float


@struct.dataclass
class RotorThrustConstants:
    """Constants of the model ``rotor_thrust``."""

    g: Scalar  # gravity, m/s^2
    mass: Scalar  # kg
    i_xx: Scalar  # inertia, kg m^2
    i_yy: Scalar
    i_zz: Scalar
    arm_x: Scalar  # distance of a rotor from the pitch axis, m
    arm_y: Scalar  # distance of a rotor from the roll axis, m
    k_torque: Scalar  # torque per thrust, m
    turning1: Scalar  # 1: counter-clockwise seen from above, -1: clockwise
    turning2: Scalar
    turning3: Scalar
    turning4: Scalar
    thrust_min: Scalar  # of one rotor, N
    thrust_max: Scalar


def forces(
    c: RotorThrustConstants, _: Rotors, thrust: Rotors, velocity: Vec3, rates: Vec3
) -> tuple[Vec3, Vec3, Rotors]:
    """The equations, with the commanded thrusts; see ``quadjax.vehicle.rigid_body.Forces``."""
    t1, t2, t3, t4 = thrust.components()
    p, q, r = rates.x, rates.y, rates.z
    torque = per_rotor(c, "turning") * thrust
    spin = Vec3(
        (c.arm_y * (t1 - t2 - t3 + t4) + (c.i_yy - c.i_zz) * q * r) / c.i_xx,
        (c.arm_x * (t1 + t2 - t3 - t4) + (c.i_zz - c.i_xx) * r * p) / c.i_yy,
        (c.k_torque * sum(torque.components()) + (c.i_xx - c.i_yy) * p * q) / c.i_zz,
    )
    zero = jnp.zeros_like(t1)
    force = Vec3(zero, zero, -(t1 + t2 + t3 + t4) / c.mass)
    return force, spin, Rotors.same(zero)


def thrust_range(c: RotorThrustConstants) -> tuple[Rotors, Rotors]:
    """Lowest and highest thrust of each rotor, N."""
    return Rotors.same(c.thrust_min), Rotors.same(c.thrust_max)


def _hold(state: RigidBodyState, command: Rotors) -> RigidBodyState:
    return state.replace(rotors=command)


MODEL = rigid_body_model(
    "rotor_thrust",
    RotorThrustConstants,
    command=Signal("rotor_thrust", 4, "N"),
    rotors=Signal("rotor_thrust", 4, "N"),
    forces=forces,
    rotor_range=thrust_range,
    command_range=thrust_range,
    hover=lambda c: Rotors.same(jnp.clip(0.25 * c.mass * c.g, c.thrust_min, c.thrust_max)),
    hold=_hold,
    groups={
        "gravity": ("g",),
        "inertia": ("i_xx", "i_yy", "i_zz"),
        "thrust": ("mass",),
        "moment": ("arm_x", "arm_y"),
        "yaw": ("k_torque",),
        "limits": ("thrust_min", "thrust_max"),
    },
    positive=("g", "mass", "i_xx", "i_yy", "i_zz", "arm_x", "arm_y", "k_torque"),
    ranges=(("thrust_min", "thrust_max"),),
    thrust_to_weight=lambda c: 4.0 * c["thrust_max"] / (c["mass"] * c["g"]),
)
