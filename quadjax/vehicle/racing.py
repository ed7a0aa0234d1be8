"""Racing quadcopters: rigid bodies with normalized motor commands and constants for each rotor.

Equations and constants of ``racing``: Ferede et al., "One Net to Rule Them All" (arXiv 2504.21586);
of ``a2rl``, which adds aerodynamic and gyroscopic terms: "MonoRace" (arXiv 2601.15222), in the form
of the published code. Forces and moments are specific (no mass, no inertia), rotor speeds in rad/s.
Rotors: 1 front-left, 2 front-right, 3 rear-right, 4 rear-left.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.gradients import bounded_sqrt
from quadjax.core.trigonometry import arctan2
from quadjax.core.vectors import Rotors, Vec3, between
from quadjax.vehicle.protocol import Signal
from quadjax.vehicle.rigid_body import per_rotor, rigid_body_model

Scalar = jax.Array | float
NEWTON_STEPS = 6
SLOPE_FLOOR = 0.05  # fraction of the speed range below which the motor map's slope is bounded


@struct.dataclass
class RacingConstants:
    """Constants of the model ``racing``."""

    g: Scalar  # gravity, m/s^2
    k_w: Scalar  # thrust, m/s^2/(rad/s)^2
    k_x: Scalar  # rotor drag, 1/rad
    k_y: Scalar
    k_p1: Scalar  # roll moment, rad/s^2/(rad/s)^2
    k_p2: Scalar
    k_p3: Scalar
    k_p4: Scalar
    k_q1: Scalar  # pitch moment, rad/s^2/(rad/s)^2
    k_q2: Scalar
    k_q3: Scalar
    k_q4: Scalar
    k_r1: Scalar  # yaw moment of rotor drag, rad/s^2/(rad/s)
    k_r2: Scalar
    k_r3: Scalar
    k_r4: Scalar
    k_rd1: Scalar  # yaw moment of rotor acceleration, rad/s^2/(rad/s^2)
    k_rd2: Scalar
    k_rd3: Scalar
    k_rd4: Scalar
    turning1: Scalar  # 1: counter-clockwise seen from above, -1: clockwise
    turning2: Scalar
    turning3: Scalar
    turning4: Scalar
    w_min: Scalar  # rad/s, speed at command 0
    w_max: Scalar  # rad/s, speed at command 1
    k: Scalar  # curvature of the motor map, 0 to 1
    tau: Scalar  # motor time constant, s


@struct.dataclass
class A2RLConstants(RacingConstants):
    """Constants of the model ``a2rl``."""

    k_angle: Scalar  # thrust by angle of attack, 1/rad
    k_hor: Scalar  # thrust by advance, 1/rad
    k_v2: Scalar  # quadratic drag, 1/m
    k_x2: Scalar
    k_y2: Scalar
    j_x: Scalar  # gyroscopic coupling
    j_y: Scalar
    j_z: Scalar
    rotor_radius: Scalar  # m


def motor_map(c: RacingConstants, command: Rotors) -> Rotors:
    """Steady speeds, rad/s, of commands U in [0, 1].

    ``(w_max - w_min) sqrt(k U^2 + (1 - k) U) + w_min``, with k clipped to [0, 1]. The slope is
    infinite at U = 0; its derivative here is bounded.
    """
    k = jnp.clip(c.k, 0.0, 1.0)

    def speed(u: jax.Array) -> jax.Array:
        part = bounded_sqrt(k * u * u + (1.0 - k) * u, SLOPE_FLOOR)
        return c.w_min + (c.w_max - c.w_min) * part

    return Rotors(*map(speed, command.components()))


def command_of(c: RacingConstants, speed: Rotors) -> Rotors:
    """Commands in [0, 1] of steady speeds, rad/s: the inverse of ``motor_map``."""
    k = jnp.clip(c.k, 0.0, 1.0)

    def command(w: jax.Array) -> jax.Array:
        part = jnp.clip((w - c.w_min) / (c.w_max - c.w_min), 0.0, 1.0)
        below = (1.0 - k) + jnp.sqrt((1.0 - k) ** 2 + 4.0 * k * part * part)
        return jnp.where(below > 0, 2.0 * part * part / jnp.where(below > 0, below, 1.0), 0.0)

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
    p, q = per_rotor(c, "k_p") * square, per_rotor(c, "k_q") * square
    r = per_rotor(c, "k_r") * speed + per_rotor(c, "k_rd") * speed_rate
    return Vec3(
        p.w1 - p.w2 - p.w3 + p.w4,
        q.w1 + q.w2 - q.w3 - q.w4,
        _total(per_rotor(c, "turning") * r),
    )


def forces(
    c: RacingConstants, speed: Rotors, command: Rotors, velocity: Vec3, rates: Vec3
) -> tuple[Vec3, Vec3, Rotors]:
    """The equations of ``racing``; see ``quadjax.vehicle.rigid_body.Forces``."""
    speed_rate = (motor_map(c, command) - speed) / c.tau
    return nominal_force(c, speed, velocity), nominal_spin(c, speed, speed_rate), speed_rate


def a2rl_forces(
    c: A2RLConstants, speed: Rotors, command: Rotors, velocity: Vec3, rates: Vec3
) -> tuple[Vec3, Vec3, Rotors]:
    """The equations of ``a2rl``: those of ``racing`` and three kinds of terms.

    - thrust times ``1 + k_angle alpha + k_hor mu`` with ``alpha = atan2(v_z, R w)`` and
      ``mu = atan2(v_x^2 + v_y^2, (R w)^2)``, ``w`` the mean rotor speed;
    - quadratic drag;
    - gyroscopic moments ``(j_x q r, j_y p r, j_z p q)``.
    """
    force, spin, speed_rate = forces(c, speed, command, velocity, rates)
    tip = c.rotor_radius * 0.25 * _total(speed)
    vx, vy, vz = velocity.x, velocity.y, velocity.z
    alpha, mu = arctan2(vz, tip), arctan2(vx * vx + vy * vy, tip * tip)
    gain = 1.0 + c.k_angle * alpha + c.k_hor * mu
    drag = Vec3(c.k_x2 * vx * jnp.abs(vx), c.k_y2 * vy * jnp.abs(vy), c.k_v2 * vz * jnp.abs(vz))
    p, q, r = rates.x, rates.y, rates.z
    coupling = Vec3(c.j_x * q * r, c.j_y * p * r, c.j_z * p * q)
    return force.replace(z=force.z * gain) - drag, spin + coupling, speed_rate


def speed_range(c: RacingConstants) -> tuple[Rotors, Rotors]:
    """Lowest and highest rotor speeds, rad/s."""
    return Rotors.same(c.w_min), Rotors.same(c.w_max)


def command_range(c: RacingConstants) -> tuple[Rotors, Rotors]:
    """Lowest and highest command: 0 and 1."""
    zero = jnp.zeros_like(jnp.asarray(c.w_min))
    return Rotors.same(zero), Rotors.same(zero + 1.0)


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


# The distribution of "One Net to Rule Them All": lowest and highest values; k_w, k_p and k_q times
# w_max^2, k_x, k_y, k_r and k_rd times w_max. Roll and pitch moments differ among the rotors.
ALL_RACING_DRONES = {
    "w_min": (0.0, 500.0),
    "w_max": (3000.0, 5000.0),
    "k": (0.0, 1.0),
    "tau": (0.01, 0.1),
    "k_w": (10.0, 30.0),
    "k_x": (0.1, 0.3),
    "k_y": (0.1, 0.3),
    "k_r": (20.0, 80.0),
    "k_rd": (2.0, 8.0),
    "k_p": (200.0, 800.0),
    "k_q": (200.0, 800.0),
}
ROTOR_DIFFERENCE = 50.0


def all_racing_drones(nominal: RacingConstants, drawn: jax.Array) -> RacingConstants:
    """A drone of ``ALL_RACING_DRONES``, of at least 19 numbers in [-1, 1]; ``g`` as given."""
    count = len(ALL_RACING_DRONES)
    found = {
        name: between(*span, drawn[index])
        for index, (name, span) in enumerate(ALL_RACING_DRONES.items())
    }
    w = found["w_max"]
    for name in ("k_w", "k_p", "k_q"):
        found[name] = found[name] / (w * w)
    for name in ("k_x", "k_y", "k_r", "k_rd"):
        found[name] = found[name] / w
    for axis, name in enumerate(("k_p", "k_q", "k_r", "k_rd")):
        value = found.pop(name)
        for rotor in range(4):
            own = ROTOR_DIFFERENCE * drawn[count + 4 * axis + rotor] / (w * w) if axis < 2 else 0.0
            found[f"{name}{rotor + 1}"] = value + own
    return nominal.replace(**found)


# The randomization of the fastest (M16) and of the most robust network of "MonoRace", as fractions.
MONORACE_FASTEST = {
    **{"thrust": 0.15, "drag": 0.2, "aerodynamics": 0.45, "moment": 0.45, "yaw": 0.45},
    **{"gyroscopic": 0.5, "w_min": 0.2, "w_max": 0.15, "motor_map": 0.45, "lag": 0.3},
}
MONORACE_ROBUST = {
    **dict.fromkeys(("thrust", "drag", "aerodynamics", "moment", "yaw", "gyroscopic"), 0.5),
    **{"w_min": 0.5, "w_max": 0.4, "motor_map": 0.5, "lag": 0.55},
}
ROBUST_LAG = 0.025  # s, the time constant about which MONORACE_ROBUST draws


def monorace_fastest(nominal: A2RLConstants, drawn: jax.Array) -> A2RLConstants:
    """A drone of ``MONORACE_FASTEST``, of one number in [-1, 1] for each constant."""
    return _scaled(nominal, MONORACE_FASTEST, drawn)


def monorace_robust(nominal: A2RLConstants, drawn: jax.Array) -> A2RLConstants:
    """A drone of ``MONORACE_ROBUST``, of one number in [-1, 1] for each constant."""
    return _scaled(nominal.replace(tau=ROBUST_LAG), MONORACE_ROBUST, drawn)


def _scaled(
    nominal: A2RLConstants, fractions: Mapping[str, float], drawn: jax.Array
) -> A2RLConstants:
    """Constants, each times 1 +- the fraction of its group or of its own name."""
    names = [field.name for field in dataclasses.fields(nominal)]
    found = {}
    for key, fraction in fractions.items():
        for name in A2RL_GROUPS.get(key, (key,)):
            own = drawn[names.index(name)]
            found[name] = getattr(nominal, name) * (1.0 + fraction * own)
    return nominal.replace(**found)


GROUPS = {
    "gravity": ("g",),
    "thrust": ("k_w",),
    "drag": ("k_x", "k_y"),
    "moment": tuple(f"{name}{rotor}" for name in ("k_p", "k_q") for rotor in (1, 2, 3, 4)),
    "yaw": tuple(f"{name}{rotor}" for name in ("k_r", "k_rd") for rotor in (1, 2, 3, 4)),
    "lag": ("tau",),
    "limits": ("w_min", "w_max"),
    "motor_map": ("k",),
}
A2RL_GROUPS = GROUPS | {
    "gyroscopic": ("j_x", "j_y", "j_z"),
    "aerodynamics": ("k_angle", "k_hor", "k_v2", "k_x2", "k_y2"),
}
COMMON = {
    "command": Signal("motor_command", 4, ""),
    "rotors": Signal("rotor_speed", 4, "rad/s"),
    "rotor_range": speed_range,
    "hover": hover_speed,
    "command_range": command_range,
    "positive": ("g", "k_w", "tau", *GROUPS["moment"], *GROUPS["yaw"][:4]),
    "nonnegative": ("k_x", "k_y", *GROUPS["yaw"][4:]),
    "ranges": (("w_min", "w_max"),),
    "lags": ("tau",),
    "thrust_to_weight": lambda c: 4.0 * c["k_w"] * c["w_max"] ** 2 / c["g"],
}
MODEL = rigid_body_model(
    "racing",
    RacingConstants,
    forces=forces,
    groups=GROUPS,
    populations={"all_racing_drones": all_racing_drones},
    **COMMON,
)
A2RL = rigid_body_model(
    "a2rl",
    A2RLConstants,
    forces=a2rl_forces,
    groups=A2RL_GROUPS,
    populations={"monorace_fastest": monorace_fastest, "monorace_robust": monorace_robust},
    **COMMON,
)
