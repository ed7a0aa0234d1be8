"""The rate-and-thrust (INDI) model: an inner loop follows body rates and thrust with a lag.

Equations and constants: Ferede et al., arXiv 2311.16948. World NED, body FRD.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Vec3, from_unit
from quadjax.vehicle.constants import constant
from quadjax.vehicle.protocol import Signal, VehicleModel, VehicleParams
from quadjax.vehicle.rigid_body import BodyState


class RateConstants(struct.PyTreeNode):
    """Constants of the model ``rate``."""

    g: jax.Array = constant("m/s^2", "gravity", "positive")
    d_x: jax.Array = constant("1/s", "drag", "nonnegative")
    d_y: jax.Array = constant("1/s", "drag", "nonnegative")
    tau_rate: jax.Array = constant("s", "lag", "positive")  # of the body rates
    tau_thrust: jax.Array = constant("s", "lag", "positive")
    p_max: jax.Array = constant("rad/s", "limits", "positive")
    q_max: jax.Array = constant("rad/s", "limits", "positive")
    r_max: jax.Array = constant("rad/s", "limits", "positive")
    thrust_min: jax.Array = constant("m/s^2", "limits")
    thrust_max: jax.Array = constant("m/s^2", "limits", above="thrust_min")


class RateCommand(struct.PyTreeNode):
    """A command to the inner loop."""

    rates: Vec3  # p, q, r, rad/s, body
    thrust: jax.Array  # () specific thrust, m/s^2


class Rate(VehicleModel):
    """The model ``rate``: a drone with its inner loop, for INDI policies.

    The commands are body rates, rad/s, and specific thrust, m/s^2, along body -z. The
    specific thrust is the actuator. Rates and thrust follow with first-order lags, and the drag is
    linear.
    """

    name = "rate"
    constants = RateConstants
    commands = (Signal("body_rates", 3, "rad/s"), Signal("thrust", 1, "m/s^2"))
    actuators = Signal("thrust", 1, "m/s^2")

    def actuator_rate(
        self, c: RateConstants, actuators: jax.Array, command: RateCommand
    ) -> jax.Array:
        """Derivative of the thrust, m/s^3."""
        return (command.thrust - actuators) / c.tau_thrust

    def force_moment(self, params: VehicleParams, body: BodyState) -> tuple[Vec3, Vec3]:
        """Specific force, m/s^2, of drag and thrust; the inner loop gives the moment."""
        c = params.constants
        drag = (-c.d_x * body.velocity.x, -c.d_y * body.velocity.y)
        return Vec3(*drag, -body.actuators), Vec3.zero()

    def angular_acceleration(
        self, c: RateConstants, moment: Vec3, rates: Vec3, command: RateCommand
    ) -> Vec3:
        """The derivative of the body rates, rad/s^2, of the inner loop."""
        return (command.rates - rates) / c.tau_rate

    def command_range(self, c: RateConstants) -> tuple[RateCommand, RateCommand]:
        """Lowest and highest command."""
        high = RateCommand(Vec3(c.p_max, c.q_max, c.r_max), c.thrust_max)
        low = RateCommand(Vec3(-c.p_max, -c.q_max, -c.r_max), c.thrust_min)
        return low, high

    def actuator_range(self, c: RateConstants) -> tuple[jax.Array, jax.Array]:
        """Lowest and highest thrust, m/s^2."""
        return c.thrust_min, c.thrust_max

    def start_actuators(
        self, c: RateConstants, numbers: jax.Array, thrust: tuple[jax.Array, jax.Array]
    ) -> jax.Array:
        """The thrust drawn over the range ``thrust``, m/s^2, and clipped to that of commands."""
        return jnp.clip(from_unit(*thrust, numbers[0]), c.thrust_min, c.thrust_max)

    def hover_actuators(self, c: RateConstants) -> jax.Array:
        """The thrust of a hover, m/s^2, clipped to that of commands."""
        return jnp.clip(c.g, c.thrust_min, c.thrust_max)

    def thrust_to_weight(self, c: RateConstants) -> jax.Array:
        """Thrust at the highest command over weight."""
        return c.thrust_max / c.g


MODEL = Rate()
