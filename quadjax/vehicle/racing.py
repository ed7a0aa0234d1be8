"""Racing quadcopters: rigid bodies with normalized motor commands and constants for each rotor.

Equations and constants of ``racing``: Ferede et al., "One Net to Rule Them All" (arXiv 2504.21586);
of ``a2rl``, which adds aerodynamic and gyroscopic terms: "MonoRace" (arXiv 2601.15222), in the form
of the published code. Forces and moments are specific (no mass, no inertia), rotor speeds in rad/s.
Rotors: 1 front-left, 2 front-right, 3 rear-right, 4 rear-left.
"""

import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.gradients import bounded_sqrt
from quadjax.core.trigonometry import arctan2
from quadjax.core.vectors import Rotors, Vec3, from_unit
from quadjax.vehicle.constants import constant, constant_names, from_values, values_of
from quadjax.vehicle.protocol import Signal, VehicleModel, VehicleParams
from quadjax.vehicle.rigid_body import BodyState

NEWTON_STEPS = 6
SLOPE_FLOOR = 0.05  # fraction of the speed range below which the motor map's slope is bounded


class RacingConstants(struct.PyTreeNode):
    """Constants of the model ``racing``."""

    g: jax.Array = constant("m/s^2", "gravity", "positive")
    k_w: jax.Array = constant("m/s^2/(rad/s)^2", "thrust", "positive")
    k_x: jax.Array = constant("1/rad", "drag", "nonnegative")  # rotor drag
    k_y: jax.Array = constant("1/rad", "drag", "nonnegative")
    k_p: Rotors = constant("rad/s^2/(rad/s)^2", "moment", "positive")  # roll
    k_q: Rotors = constant("rad/s^2/(rad/s)^2", "moment", "positive")  # pitch
    k_r: Rotors = constant("rad/s^2/(rad/s)", "yaw", "positive")  # rotor drag
    k_rd: Rotors = constant("rad/s^2/(rad/s^2)", "yaw", "nonnegative")  # rotor acceleration
    turning: Rotors = constant(sign="direction")  # 1: counter-clockwise seen from above
    w_min: jax.Array = constant("rad/s", "limits")  # speed at command 0
    w_max: jax.Array = constant("rad/s", "limits", above="w_min")  # speed at command 1
    k: jax.Array = constant("", "motor_map")  # curvature of the motor map, 0 to 1
    tau: jax.Array = constant("s", "lag", "positive")  # of the motors


class A2RLConstants(RacingConstants):
    """Constants of the model ``a2rl``."""

    k_angle: jax.Array = constant("1/rad", "aerodynamics")  # thrust by angle of attack
    k_hor: jax.Array = constant("1/rad", "aerodynamics")  # thrust by advance
    k_v2: jax.Array = constant("1/m", "aerodynamics")  # quadratic drag
    k_x2: jax.Array = constant("1/m", "aerodynamics")
    k_y2: jax.Array = constant("1/m", "aerodynamics")
    j_x: jax.Array = constant("", "gyroscopic")
    j_y: jax.Array = constant("", "gyroscopic")
    j_z: jax.Array = constant("", "gyroscopic")
    rotor_radius: jax.Array = constant("m")


def motor_map(c: RacingConstants, command: Rotors) -> Rotors:
    """Steady speeds, rad/s, of commands U in [0, 1].

    ``(w_max - w_min) sqrt(k U^2 + (1 - k) U) + w_min``, with k clipped to [0, 1]. The slope is
    infinite at U = 0; its derivative here is bounded.
    """
    k = jnp.clip(c.k, 0.0, 1.0)

    def speed(u: jax.Array) -> jax.Array:
        share = bounded_sqrt(k * u * u + (1.0 - k) * u, SLOPE_FLOOR)
        return c.w_min + (c.w_max - c.w_min) * share

    return Rotors(*map(speed, command.components()))


def command_of(c: RacingConstants, speed: Rotors) -> Rotors:
    """Commands in [0, 1] of steady speeds, rad/s: the inverse of ``motor_map``."""
    k = jnp.clip(c.k, 0.0, 1.0)

    def command(w: jax.Array) -> jax.Array:
        share = jnp.clip((w - c.w_min) / (c.w_max - c.w_min), 0.0, 1.0)
        below = (1.0 - k) + jnp.sqrt((1.0 - k) ** 2 + 4.0 * k * share * share)
        return jnp.where(below > 0, 2.0 * share * share / jnp.where(below > 0, below, 1.0), 0.0)

    return Rotors(*map(command, speed.components()))


def _total(values: Rotors) -> jax.Array:
    return values.w1 + values.w2 + values.w3 + values.w4


def nominal_force(c: RacingConstants, speed: Rotors, velocity: Vec3) -> Vec3:
    """Thrust and rotor drag, m/s^2, of rotor speeds, rad/s, and body velocity, m/s."""
    total = _total(speed)
    return Vec3(
        -c.k_x * velocity.x * total, -c.k_y * velocity.y * total, -c.k_w * _total(speed * speed)
    )


def nominal_spin(c: RacingConstants, speed: Rotors, speed_rate: Rotors) -> Vec3:
    """Angular acceleration, rad/s^2, of rotor speeds, rad/s, and their derivatives, rad/s^2."""
    square = speed * speed
    p, q = c.k_p * square, c.k_q * square
    r = c.k_r * speed + c.k_rd * speed_rate
    return Vec3(p.w1 - p.w2 - p.w3 + p.w4, q.w1 + q.w2 - q.w3 - q.w4, _total(c.turning * r))


def hover_speed(c: RacingConstants) -> Rotors:
    """Rotor speeds, rad/s, without angular acceleration whose thrust is the weight.

    Newton's method from equal speeds; equal speeds where there is no solution. Clipped to the range
    of the motors.
    """
    equal = jnp.sqrt(c.g / (4.0 * c.k_w))
    zero = jnp.zeros_like(equal)

    def imbalance(speed: jax.Array) -> jax.Array:
        w = Rotors.of(speed)
        spin = nominal_spin(c, w, Rotors.same(zero))
        lift = nominal_force(c, w, Vec3(zero, zero, zero)).z + c.g
        return jnp.stack([lift, *spin.components()])

    speed = jnp.stack([equal] * 4)
    for _ in range(NEWTON_STEPS):
        speed = speed - jnp.linalg.solve(jax.jacfwd(imbalance)(speed), imbalance(speed))
    speed = jnp.where(jnp.all(jnp.isfinite(speed)), speed, equal)
    return Rotors.of(jnp.clip(speed, c.w_min, c.w_max))


# The distribution of "One Net to Rule Them All": lowest and highest values, times a power of w_max.
# Roll and pitch moments differ among the rotors.
ALL_RACING_DRONES = {
    "w_min": (0.0, 500.0, 0),
    "w_max": (3000.0, 5000.0, 0),
    "k": (0.0, 1.0, 0),
    "tau": (0.01, 0.1, 0),
    "k_w": (10.0, 30.0, 2),
    "k_x": (0.1, 0.3, 1),
    "k_y": (0.1, 0.3, 1),
    "k_r": (20.0, 80.0, 1),
    "k_rd": (2.0, 8.0, 1),
    "k_p": (200.0, 800.0, 2),
    "k_q": (200.0, 800.0, 2),
}
ROTOR_DIFFERENCE = 50.0


def all_racing_drones(nominal: RacingConstants, numbers: jax.Array) -> RacingConstants:
    """A drone of ``ALL_RACING_DRONES``, of at least 19 numbers in [-1, 1]; ``g`` as given."""
    count, values = len(ALL_RACING_DRONES), dict[str, Any]()
    for index, (name, (low, high, power)) in enumerate(ALL_RACING_DRONES.items()):
        value = from_unit(low, high, numbers[index])
        values[name] = value / values["w_max"] ** power if power else value
    for axis, name in enumerate(("k_p", "k_q")):
        draws = (numbers[count + 4 * axis + rotor] for rotor in range(4))
        widths = (ROTOR_DIFFERENCE * draw / values["w_max"] ** 2 for draw in draws)
        values[name] = Rotors(*(values[name] + width for width in widths))
    for name in ("k_r", "k_rd"):
        values[name] = Rotors.same(values[name])
    return nominal.replace(**values)


# The randomization of the fastest (M16) and of the most robust network of "MonoRace", as fractions
# by group or by name.
MONORACE_FASTEST = {
    **{"thrust": 0.15, "drag": 0.2, "aerodynamics": 0.45, "moment": 0.45, "yaw": 0.45},
    **{"gyroscopic": 0.5, "w_min": 0.2, "w_max": 0.15, "motor_map": 0.45, "lag": 0.3},
}
MONORACE_ROBUST = {
    **dict.fromkeys(("thrust", "drag", "aerodynamics", "moment", "yaw", "gyroscopic"), 0.5),
    **{"w_min": 0.5, "w_max": 0.4, "motor_map": 0.5, "lag": 0.55},
}
ROBUST_LAG_S = 0.025  # the time constant about which MONORACE_ROBUST draws


def _scaled(
    fractions: Mapping[str, float],
    changes: Mapping[str, float],
    nominal: A2RLConstants,
    numbers: jax.Array,
) -> A2RLConstants:
    """Constants, each times 1 +- the fraction of its group or of its own name.

    ``changes`` replace nominal constants by name; there is one number in [-1, 1] for each constant.
    """
    names, values = constant_names(A2RLConstants), values_of(nominal.replace(**changes))
    changed = {
        name: values[name] * (1.0 + fraction * numbers[names.index(name)])
        for key, fraction in fractions.items()
        for name in A2RL.groups.get(key, (key,))
    }
    return from_values(A2RLConstants, values | changed)


class Racing(VehicleModel):
    """The model ``racing``: four motor commands ``u``, 0 to 1; the actuators are rotor speeds.

    With rotor speeds ``w``, rad/s, and body velocity ``v``, specific force, m/s^2, and angular
    acceleration, rad/s^2, are

    ```text
    F = (-k_x vx sum(w), -k_y vy sum(w), -k_w sum(w^2))
    p' = k_p1 w1^2 - k_p2 w2^2 - k_p3 w3^2 + k_p4 w4^2
    q' = k_q1 w1^2 + k_q2 w2^2 - k_q3 w3^2 - k_q4 w4^2
    r' = sum(turning_i (k_r_i w_i + k_rd_i w_i'))
    w' = (w_min + (w_max - w_min) sqrt(k u^2 + (1 - k) u) - w) / tau
    ```
    """

    name = "racing"
    constants = RacingConstants
    commands = (Signal("motor_command", 4, ""),)
    actuators = Signal("rotor_speed", 4, "rad/s")
    populations = {"all_racing_drones": all_racing_drones}
    can_be_disturbed = True
    moment_unit = "rad/s^2"

    def actuator_rate(self, c: RacingConstants, actuators: Rotors, command: Rotors) -> Rotors:
        """Derivatives of the rotor speeds, rad/s^2."""
        return (motor_map(c, command) - actuators) / c.tau

    def force_moment(self, params: VehicleParams, body: BodyState) -> tuple[Vec3, Vec3]:
        """Specific force, m/s^2, and angular acceleration, rad/s^2."""
        c, speed = params.constants, body.actuators
        return nominal_force(c, speed, body.velocity), nominal_spin(c, speed, body.actuator_rate)

    def angular_momentum(
        self, c: RacingConstants, actuators: Rotors, rates: Vec3
    ) -> tuple[Vec3, Vec3]:
        """Body rates minus the part of the rotors, rad/s; the moment has the gyroscopic terms."""
        rotors = _total(c.turning * (c.k_rd * actuators))
        return rates.replace(z=rates.z - rotors), Vec3.zero()

    def command_range(self, c: RacingConstants) -> tuple[Rotors, Rotors]:
        """Lowest and highest command: 0 and 1."""
        zero = jnp.zeros_like(jnp.asarray(c.w_min))
        return Rotors.same(zero), Rotors.same(zero + 1.0)

    def actuator_range(self, c: RacingConstants) -> tuple[Rotors, Rotors]:
        """Lowest and highest rotor speeds, rad/s."""
        return Rotors.same(c.w_min), Rotors.same(c.w_max)

    def hover_actuators(self, c: RacingConstants) -> Rotors:
        """Rotor speeds of a hover, rad/s; see ``hover_speed``."""
        return hover_speed(c)

    def allocation(self, c: RacingConstants) -> np.ndarray:
        """Thrust, roll, pitch and yaw (4, 4) of each rotor alone, at 1 rad/s."""
        alone, zero = Rotors(*np.eye(4)), Vec3(*np.zeros(3))
        spin = nominal_spin(c, alone, Rotors(*np.zeros(4)))
        thrust = -nominal_force(c, alone, zero).z
        return np.array([thrust, *spin.components()], np.float64)

    def thrust_to_weight(self, c: RacingConstants) -> jax.Array:
        """Thrust at the highest command over weight."""
        return 4.0 * c.k_w * c.w_max**2 / c.g


class A2RLRacing(Racing):
    """The model ``a2rl``: the equations of ``racing`` and three kinds of terms.

    - thrust times ``1 + k_angle alpha + k_hor mu`` with ``alpha = atan2(v_z, R w)`` and
      ``mu = atan2(v_x^2 + v_y^2, (R w)^2)``, ``w`` the mean rotor speed;
    - quadratic drag;
    - gyroscopic moments ``(j_x q r, j_y p r, j_z p q)``.
    """

    name = "a2rl"
    constants = A2RLConstants
    populations = {
        "monorace_fastest": functools.partial(_scaled, MONORACE_FASTEST, {}),
        "monorace_robust": functools.partial(_scaled, MONORACE_ROBUST, {"tau": ROBUST_LAG_S}),
    }

    def force_moment(self, params: VehicleParams, body: BodyState) -> tuple[Vec3, Vec3]:
        """Specific force, m/s^2, and angular acceleration, rad/s^2."""
        c, rates = params.constants, body.rates
        force, spin = super().force_moment(params, body)
        tip = c.rotor_radius * 0.25 * _total(body.actuators)
        vx, vy, vz = body.velocity.x, body.velocity.y, body.velocity.z
        alpha, mu = arctan2(vz, tip), arctan2(vx * vx + vy * vy, tip * tip)
        gain = 1.0 + c.k_angle * alpha + c.k_hor * mu
        drag = Vec3(c.k_x2 * vx * jnp.abs(vx), c.k_y2 * vy * jnp.abs(vy), c.k_v2 * vz * jnp.abs(vz))
        p, q, r = rates.x, rates.y, rates.z
        coupling = Vec3(c.j_x * q * r, c.j_y * p * r, c.j_z * p * q)
        return force.replace(z=force.z * gain) - drag, spin + coupling


MODEL = Racing(quaternion=True)
A2RL = A2RLRacing(quaternion=True)
