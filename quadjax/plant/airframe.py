"""Measured deviations of a drone's force and moment from its model: polynomials of its motion.

A config lists the terms of the force along body z and of the moment. Each is a product of up to two
variables: the mean ``w`` of the propeller speeds and their differences ``roll``, ``pitch``, ``yaw``
(a quarter of the sum with the signs of the moment that they make), all in 10,000 rpm; the velocity
through the air ``vx``, ``vy``, ``vz``, m/s, and the rates ``p``, ``q``, ``r``, rad/s, body FRD; and
the speed ``v`` along the plane of the rotors, m/s.
"""

import math

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.config import OUTPUTS, VARIABLES, AirframeConfig
from quadjax.plant.indi import PITCH, ROLL, YAW, total

RPM_UNIT = 1.0e4  # unit of the propeller speeds


class AirframeDeviations(struct.PyTreeNode):
    """The polynomials of one drone."""

    low: tuple[jax.Array, ...]  # () of each variable: it enters with at least this
    high: tuple[jax.Array, ...]
    coefficients: tuple[tuple[jax.Array, ...], ...]  # of each output's terms
    terms: tuple[tuple[tuple[int, ...], ...], ...] = struct.field(pytree_node=False)  # variables


def make_airframe(config: AirframeConfig) -> AirframeDeviations | None:
    """The polynomials of a config; None if it has no term."""
    terms = [getattr(config, output) for output in OUTPUTS]
    if not any(terms):
        return None
    limits = [config.limits.get(name, (-math.inf, math.inf)) for name in VARIABLES]
    return AirframeDeviations(
        low=tuple(jnp.float32(low) for low, _ in limits),
        high=tuple(jnp.float32(high) for _, high in limits),
        coefficients=tuple(tuple(map(jnp.float32, each.values())) for each in terms),
        terms=tuple(tuple(map(variables_of, each)) for each in terms),
    )


def variables_of(term: str) -> tuple[int, ...]:
    """Indices of the variables of a term such as ``vx*vx``; none of the constant ``1``."""
    return () if term == "1" else tuple(VARIABLES.index(name) for name in term.split("*"))


def airframe_force_moment(
    airframe: AirframeDeviations, rpm: Rotors, air_velocity: Vec3, rates: Vec3
) -> tuple[jax.Array, Vec3]:
    """What a drone has beyond its model: specific force () along body z, m/s^2, and moment, N m.

    Of propeller speeds, rpm, velocity through the air, m/s, and rates, rad/s, body frame. A
    variable beyond its limits enters as at the limit.
    """
    speeds = rpm * (0.25 / RPM_UNIT)
    mean = speeds.w1 + speeds.w2 + speeds.w3 + speeds.w4
    differences = (total(signs, speeds) for signs in (ROLL, PITCH, YAW))
    along = jnp.sqrt(air_velocity.x**2 + air_velocity.y**2 + 1.0e-6)
    values = (mean, *differences, along, *air_velocity.components(), *rates.components())
    bounded = [
        jnp.clip(value, low, high)
        for value, low, high in zip(values, airframe.low, airframe.high, strict=True)
    ]

    def polynomial(coefficients: tuple, terms: tuple) -> jax.Array:
        result = jnp.zeros_like(mean)
        for coefficient, term in zip(coefficients, terms, strict=True):
            result = result + math.prod([bounded[i] for i in term], start=coefficient)
        return result

    force, *moment = map(polynomial, airframe.coefficients, airframe.terms)
    return force, Vec3(*moment)
