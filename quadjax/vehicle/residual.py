"""Residual thrust and moment networks on top of the nominal model.

N_T has seven inputs (four propeller speeds, body velocity) and one output, a specific force in
m/s^2; N_M has ten (the same and the body rates) and three outputs in N m. Propeller speeds enter
scaled to [-1, 1], the others in SI (Ferede et al., arXiv 2311.16948).
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import mlp
from quadjax.core.vectors import Rotors, Vec3

Layers = tuple[tuple[jax.Array, jax.Array], ...]  # (kernel (in, out), bias (out,)) per layer


class Residual(struct.PyTreeNode):
    """Two ReLU networks, the scaling of their inputs and the sign of the first."""

    thrust: Layers  # 7 -> .. -> 1
    moment: Layers  # 10 -> .. -> 3
    rpm_min: jax.Array  # rpm that enters as -1
    rpm_max: jax.Array  # rpm that enters as +1
    thrust_sign: jax.Array  # +1: added to the body-z specific force; -1: subtracted


def scale_residual(residual: Residual, gain: jax.Array) -> Residual:
    """The residual with its outputs multiplied by ``gain`` ()."""

    def scale(layers: Layers) -> Layers:
        kernel, bias = layers[-1]
        return (*layers[:-1], (gain * kernel, gain * bias))

    return residual.replace(thrust=scale(residual.thrust), moment=scale(residual.moment))


def residual_force_moment(
    residual: Residual, rpm: Rotors, body_velocity: Vec3, body_rates: Vec3
) -> tuple[jax.Array, Vec3]:
    """What the networks add to the nominal model.

    Args:
        residual: the networks.
        rpm: propeller speeds, rpm.
        body_velocity: m/s, body frame.
        body_rates: rad/s.

    Returns:
        The addition to the body-z specific force (), m/s^2, sign already applied, and to the
        moments, N m.
    """
    span = residual.rpm_max - residual.rpm_min
    scaled_rpm = 2.0 * (rpm.array() - residual.rpm_min) / span - 1.0
    thrust_inputs = jnp.concatenate([scaled_rpm, body_velocity.array()])
    force_z = residual.thrust_sign * mlp.apply(residual.thrust, thrust_inputs)[0]
    moment_inputs = jnp.concatenate([thrust_inputs, body_rates.array()])
    return force_z, Vec3.of(mlp.apply(residual.moment, moment_inputs))
