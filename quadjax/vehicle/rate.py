"""The rate-and-thrust (INDI) model: an inner loop follows body rates and thrust with a lag.

Equations and constants: Ferede et al., arXiv 2311.16948. World NED, body FRD.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.vehicle.constants import RateConstants
from quadjax.vehicle.frames import attitude, body_to_world, euler_rates, world_to_body


@struct.dataclass
class RateState:
    """State of one drone."""

    position: jax.Array  # (3,) m, world
    velocity: jax.Array  # (3,) m/s, world
    euler: jax.Array  # (3,) roll, pitch, yaw, rad
    rates: jax.Array  # (3,) p, q, r, rad/s, body
    thrust: jax.Array  # () specific thrust along body -z, m/s^2


@struct.dataclass
class RateParams:
    """What the rate-level model is computed with: all of it traced."""

    constants: RateConstants


def derivative(params: RateParams, state: RateState, command: jax.Array) -> RateState:
    """Time derivative of the state, as a ``RateState``.

    Args:
        params: the constants.
        state: the drone.
        command: (4,) p, q, r in rad/s and specific thrust in m/s^2.
    """
    c = params.constants
    a = attitude(state.euler)
    body_velocity = world_to_body(a, state.velocity)
    force = jnp.stack([-c.d_x * body_velocity[0], -c.d_y * body_velocity[1], -state.thrust])
    acceleration = body_to_world(a, force)
    return RateState(
        position=state.velocity,
        velocity=jnp.stack([acceleration[0], acceleration[1], acceleration[2] + c.g]),
        euler=euler_rates(a, state.rates),
        rates=(command[:3] - state.rates) / c.tau_rate,
        thrust=(command[3] - state.thrust) / c.tau_thrust,
    )


def command_range(c: RateConstants) -> tuple[jax.Array, jax.Array]:
    """Lowest and highest command, each (4,): p, q, r in rad/s, specific thrust in m/s^2."""
    high = jnp.stack([jnp.asarray(x) for x in (c.p_max, c.q_max, c.r_max, c.thrust_max)])
    low = jnp.stack([-high[0], -high[1], -high[2], jnp.asarray(c.thrust_min)])
    return low, high
