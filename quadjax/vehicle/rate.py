"""The rate-and-thrust (INDI) model: an inner loop follows body rates and thrust with a lag.

Equations and constants: Ferede et al., arXiv 2311.16948. World NED, body FRD.
"""

import jax
from flax import struct

from quadjax.core.frames import attitude, body_to_world, euler_rates, world_to_body
from quadjax.core.materialize import Keep, call
from quadjax.core.vectors import Vec3
from quadjax.vehicle.constants import RateConstants


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
    """What the inner loop is asked for."""

    rates: Vec3  # p, q, r, rad/s, body
    thrust: jax.Array  # () specific thrust, m/s^2


@struct.dataclass
class RateParams:
    """What the rate-level model is computed with: all of it traced."""

    constants: RateConstants


def derivative(
    params: RateParams, state: RateState, command: RateCommand, keep: Keep = call
) -> RateState:
    """Time derivative of the state under a command, as a ``RateState``.

    ``keep`` calls a function in a way that its values are computed once.
    """
    c = params.constants
    a = keep(attitude, state.euler)
    body_velocity = keep(world_to_body, a, state.velocity)
    force = Vec3(-c.d_x * body_velocity.x, -c.d_y * body_velocity.y, -state.thrust)
    acceleration = body_to_world(a, force)
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
