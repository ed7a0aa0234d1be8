"""Second-order motors and the battery."""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Rotors


@struct.dataclass
class PowerParams:
    """Motors, controllers and battery, times the strengths of the effects."""

    lag: jax.Array  # s, second time constant; 0: first order
    shortfall: jax.Array  # fraction of a commanded change from hover that is not reached
    hover: jax.Array  # rpm
    sags: jax.Array  # strength of the battery's sag; 0: none
    drop: jax.Array  # fraction of the full voltage lost from full to empty
    resistance: jax.Array  # fraction of the full voltage lost at the hover current
    drain: jax.Array  # fraction of the charge used per second of hover
    rpm_full: jax.Array  # rpm reached at the full voltage


def reachable(p: PowerParams, rpm: Rotors, charge: jax.Array) -> jax.Array:
    """Highest propeller speed (), rpm, at the battery's voltage; infinite without sag.

    The no-load speed of a motor is proportional to its voltage, which falls with the charge used
    and with the current through the battery's resistance (the linear part of Tremblay and
    Dessaint, "Experimental validation of a battery dynamic model for EV applications", World
    Electric Vehicle Journal 3, 2009). The current is proportional to the rotors' power, the cube of
    their speed (Leishman, "Principles of helicopter aerodynamics", 2006, chapter 2).

    Args:
        p: of motors and battery.
        rpm: propeller speeds, rpm.
        charge: () left, 0 to 1.
    """
    left = 1.0 - p.sags * (p.drop * (1.0 - charge) + p.resistance * load(p, rpm))
    return jnp.where(p.sags > 0.0, p.rpm_full * left, jnp.inf)


def load(p: PowerParams, rpm: Rotors) -> jax.Array:
    """Power () of the rotors over that of hover."""
    part = rpm / p.hover
    cube = part * part * part
    return 0.25 * (cube.w1 + cube.w2 + cube.w3 + cube.w4)


def charge_rate(p: PowerParams, rpm: Rotors) -> jax.Array:
    """Derivative () of the charge, 1/s."""
    return -p.sags * p.drain * load(p, rpm)


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
