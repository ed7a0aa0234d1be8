"""Second-order motors and the battery."""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Rotors
from quadjax.vehicle.battery import BatteryParams


@struct.dataclass
class PowerParams:
    """Motors, controllers and battery, times the strengths of the effects."""

    lag: jax.Array  # s, second time constant; 0: first order
    shortfall: jax.Array  # fraction of a commanded change from hover that is not reached
    hover: jax.Array  # rpm
    battery: BatteryParams


def rotor_rates(
    p: PowerParams, tau: jax.Array, rpm: Rotors, rpm_rate: Rotors, command: Rotors, top: jax.Array
) -> tuple[Rotors, Rotors]:
    """First and second derivative of the propeller speeds, rpm/s and rpm/s^2.

    ``tau lag omega'' + tau omega' + omega = u``: the electrical time constant of a brushless motor
    or its controller before the mechanical one (Franklin, Powell and Emami-Naeini, "Feedback
    control of dynamic systems", section 2.3). The measured speeds of the published flights deviate
    from the first-order model as well (Ferede et al., arXiv 2311.16948, figure of commanded,
    modeled and measured rpm): they rise later and do not reach the ends of the range. ``u`` is
    the command less the ``shortfall`` of its distance to hover, and at most ``top``.

    Args:
        p: of the motors.
        tau: () s, the first time constant.
        rpm: propeller speeds, rpm.
        rpm_rate: their derivatives, of second-order motors, rpm/s.
        command: rpm.
        top: () highest reachable speed, rpm.
    """

    def one(w: jax.Array, rate: jax.Array, u: jax.Array) -> tuple[jax.Array, jax.Array]:
        reached = jnp.minimum(u - p.shortfall * (u - p.hover), top)
        first = (reached - w) / tau
        second_order = p.lag > 0.0
        bend = (first - rate) / jnp.where(second_order, p.lag, 1.0)
        return jnp.where(second_order, rate, first), jnp.where(second_order, bend, 0.0)

    parts = zip(rpm.components(), rpm_rate.components(), command.components(), strict=True)
    pairs = [one(*part) for part in parts]
    return Rotors(*(pair[0] for pair in pairs)), Rotors(*(pair[1] for pair in pairs))
