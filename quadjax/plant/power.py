"""Second-order motors."""

import jax
import jax.numpy as jnp

from quadjax.core.filters import Scalar
from quadjax.core.vectors import Rotors


def rotor_rates(
    tau: Scalar, lag: Scalar, rpm: Rotors, rpm_rate: Rotors, target: Rotors
) -> tuple[Rotors, Rotors]:
    """First and second derivative of the propeller speeds, rpm/s and rpm/s^2.

    ``tau lag omega'' + tau omega' + omega = u``: the electrical time constant of a brushless motor
    or its controller before the mechanical one (Franklin, Powell and Emami-Naeini, "Feedback
    control of dynamic systems", section 2.3). The measured speeds of the published flights deviate
    from the first-order model as well (Ferede et al., arXiv 2311.16948, figure of commanded,
    modeled and measured rpm): they rise later and do not reach the ends of the range.

    Args:
        tau: () s, the first time constant.
        lag: () s, the second one; 0: first order.
        rpm: propeller speeds, rpm.
        rpm_rate: their derivatives, of second-order motors, rpm/s.
        target: the steady speeds ``u`` of a command, rpm.
    """
    second_order = lag > 0.0
    first = (target - rpm) / tau
    bend = (first - rpm_rate) / jnp.where(second_order, lag, 1.0)
    return (
        jax.tree.map(lambda a, b: jnp.where(second_order, a, b), rpm_rate, first),
        jax.tree.map(lambda x: jnp.where(second_order, x, 0.0), bend),
    )


def steady_speeds(command: Rotors, shortfall: Scalar, hover: Scalar, top: Scalar) -> Rotors:
    """Steady propeller speeds of a command, rpm, at most ``top``.

    Args:
        command: rpm.
        shortfall: () fraction of its distance to ``hover``, rpm, that is not reached.
        hover: () rpm.
        top: () highest reachable speed, rpm.
    """
    reached = command - (command - hover) * shortfall
    return jax.tree.map(lambda u: jnp.minimum(u, top), reached)
