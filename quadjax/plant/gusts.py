"""Dryden turbulence at low altitude, one gust velocity of one drone.

MIL-F-8785C (1980), section 3.7, and MIL-HDBK-1797 (1997), appendix A: white noise through

    H_u = sigma_u sqrt(2 L_u / (pi V)) / (1 + L_u s / V)
    H_v = sigma_v sqrt(L_v / (pi V)) (1 + sqrt(3) L_v s / V) / (1 + L_v s / V)^2     and so w

with, below 1000 ft at an altitude of h feet, ``L_w = h``, ``L_u = L_v = h / (0.177 + 0.000823
h)^1.2``, ``sigma_w = 0.1 W_20``, ``sigma_u = sigma_v = sigma_w / (0.177 + 0.000823 h)^0.4``.

The second filter is ``sqrt(3) a + (1 - sqrt(3)) b`` of the noise through one lag, ``a``, and
through two, ``b``; the states have unit variance, so a deviation of zero is calm air.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.vectors import Vec3, safe_norm
from quadjax.plant.config import GustsConfig

SQRT3 = float(np.sqrt(3.0))
METERS_PER_FOOT = 0.3048
LEAST_AIRSPEED_M_S = 1.0  # of gusts past a hovering drone
DRAWS = 3  # standard normal numbers per step
START_DRAWS = 6


class GustState(struct.PyTreeNode):
    """Two memories per component; u does not use the second."""

    first: Vec3
    second: Vec3


def scales(gusts: GustsConfig) -> tuple[Vec3, Vec3]:
    """Standard deviations, m/s, and lengths, m, of the turbulence's three components."""
    feet = gusts.altitude / METERS_PER_FOOT
    shape = 0.177 + 0.000823 * feet
    vertical = 0.1 * gusts.wind
    along = vertical / shape**0.4
    length = feet / shape**1.2 * METERS_PER_FOOT
    numbers = (along, along, vertical), (length, length, gusts.altitude)
    deviations, lengths = (Vec3(*map(jnp.asarray, triple)) for triple in numbers)
    return deviations, lengths


def init(draws: jax.Array) -> GustState:
    """Stationary turbulence, from (START_DRAWS,) standard normal numbers."""
    a, rest = Vec3.of(draws[0:3]), Vec3.of(draws[3:6])
    half = float(np.sqrt(0.5))
    first = Vec3(a.x, half * a.y, half * a.z)
    second = first * 0.5 + rest * float(np.sqrt(0.125))
    return GustState(first, second)


def update(
    gusts: GustsConfig, state: GustState, velocity: Vec3, step: jax.Array, draws: jax.Array
) -> GustState:
    """The turbulence a step of () s later, of a drone at ``velocity``, m/s.

    ``draws`` holds (DRAWS,) standard normal numbers.

    The discretization is exact for white noise: ``a <- phi a + ..`` with ``phi = exp(-V dt / L)``
    keeps the variance at any step.
    """
    speed = jnp.maximum(safe_norm(velocity), LEAST_AIRSPEED_M_S)
    _, lengths = scales(gusts)
    first, second = [], []
    for axis in range(3):
        kept = jnp.exp(-speed * step / lengths[axis])
        variance = 1.0 if axis == 0 else 0.5
        new = kept * state.first[axis] + jnp.sqrt(variance * (1.0 - kept * kept)) * draws[axis]
        middle = 0.5 * (state.first[axis] + new)
        first.append(new)
        second.append(kept * state.second[axis] + (1.0 - kept) * middle)
    return GustState(Vec3(*first), Vec3(*second))


def velocity(gusts: GustsConfig, state: GustState) -> Vec3:
    """The gust, m/s: u along north, v along east, w along down."""
    a, b = state.first, state.second
    shaped = Vec3(a.x, SQRT3 * a.y + (1.0 - SQRT3) * b.y, SQRT3 * a.z + (1.0 - SQRT3) * b.z)
    return shaped * scales(gusts)[0]
