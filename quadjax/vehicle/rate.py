"""The rate-and-thrust (INDI) model: an inner loop follows body rates and thrust with a lag.

Equations and constants: Ferede et al., arXiv 2311.16948. World NED, body FRD.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.frames import attitude, body_to_world, euler_rates, world_to_body
from quadjax.core.materialize import Caller, call_directly
from quadjax.core.vectors import Vec3, between
from quadjax.vehicle.constants import RateConstants
from quadjax.vehicle.protocol import Motion, Signal, VehicleModel, VehicleParams


@struct.dataclass
class RateState:
    """State of one drone."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    euler: Vec3  # roll, pitch, yaw, rad
    rates: Vec3  # p, q, r, rad/s, body
    thrust: jax.Array  # () specific thrust along body -z, m/s^2


@struct.dataclass
class RateCommand:
    """A command to the inner loop."""

    rates: Vec3  # p, q, r, rad/s, body
    thrust: jax.Array  # () specific thrust, m/s^2


def nominal_force(c: RateConstants, body_velocity: Vec3, thrust: jax.Array) -> Vec3:
    """Specific force, m/s^2, body frame, of velocity, m/s, and specific thrust (), m/s^2."""
    return Vec3(-c.d_x * body_velocity.x, -c.d_y * body_velocity.y, -thrust)


def derivative(
    params: VehicleParams, state: RateState, command: RateCommand, call: Caller = call_directly
) -> RateState:
    """Time derivative of the state under a command, as a ``RateState``.

    ``call`` calls a function and materializes its values.
    """
    c = params.constants
    a = call(attitude, state.euler)
    body_velocity = call(world_to_body, a, state.velocity)
    acceleration = body_to_world(a, nominal_force(c, body_velocity, state.thrust))
    return RateState(
        position=state.velocity,
        velocity=acceleration.replace(z=acceleration.z + c.g),
        euler=euler_rates(a, state.rates),
        rates=(command.rates - state.rates) / c.tau_rate,
        thrust=(command.thrust - state.thrust) / c.tau_thrust,
    )


def command_range(c: RateConstants) -> tuple[RateCommand, RateCommand]:
    """Lowest and highest command."""
    high = RateCommand(Vec3(c.p_max, c.q_max, c.r_max), c.thrust_max)
    low = RateCommand(Vec3(-c.p_max, -c.q_max, -c.r_max), c.thrust_min)
    return low, high


def specific_force(params: VehicleParams, state: RateState) -> Vec3:
    """What an ideal accelerometer measures, m/s^2, body frame."""
    velocity = world_to_body(attitude(state.euler), state.velocity)
    return nominal_force(params.constants, velocity, state.thrust)


def start(
    c: RateConstants, motion: Motion, drawn: jax.Array, thrust: tuple[jax.Array, jax.Array]
) -> RateState:
    """A start with the thrust drawn over the range ``thrust``, m/s^2, of numbers in [-1, 1]."""
    value = between(*thrust, drawn[0])
    return RateState(**vars(motion), thrust=jnp.clip(value, c.thrust_min, c.thrust_max))


def hover(c: RateConstants, motion: Motion) -> RateState:
    """A start with the thrust of a hover, clipped to the thrust range."""
    return RateState(**vars(motion), thrust=jnp.clip(c.g, c.thrust_min, c.thrust_max))


MODEL = VehicleModel(
    name="rate",
    constants=RateConstants,
    commands=(Signal("body_rates", 3, "rad/s"), Signal("thrust", 1, "m/s^2")),
    actuators=Signal("thrust", 1, "m/s^2"),
    derivative=derivative,
    command_range=command_range,
    actuator_range=lambda c: (c.thrust_min, c.thrust_max),
    actuator_state=lambda state: state.thrust,
    start=start,
    hover=hover,
    specific_force=specific_force,
    groups={
        "gravity": ("g",),
        "drag": ("d_x", "d_y"),
        "lag": ("tau_rate", "tau_thrust"),
        "limits": ("p_max", "q_max", "r_max", "thrust_min", "thrust_max"),
    },
    nonnegative=("d_x", "d_y"),
    positive=("g", "tau_rate", "tau_thrust", "p_max", "q_max", "r_max"),
    ranges=(("thrust_min", "thrust_max"),),
    lags=("tau_rate", "tau_thrust"),
    thrust_to_weight=lambda c: c["thrust_max"] / c["g"],
    uses_start_thrust=True,
)
