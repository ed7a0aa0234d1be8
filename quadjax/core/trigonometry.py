"""Sine, cosine and arctangent without branches, which XLA vectorizes on a CPU."""

import jax
import jax.numpy as jnp

_LEAST_SQUARE = 1e-4  # of the distance from the origin, in the derivative of arctan2
_TAN_EIGHTH = 0.41421356  # tan(pi/8)
# pi/2 in three float32 parts, so that x - k pi/2 keeps its bits (Cody and Waite, 1980).
_HALF_PI_PARTS = (1.5703125, 4.837512969970703e-4, 7.549789948768648e-8)


@jax.custom_jvp
def sincos(angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Sine and cosine together, without branches.

    Range reduction to [-pi/4, pi/4] and two short polynomials (the minimax coefficients of
    the Cephes library's single-precision sine and cosine). In float32 the error is below 1e-7
    for angles within +-20 rad; float64 goes to the library functions.

    Args:
        angle: rad, any shape.

    Returns:
        The sine and the cosine, each of the shape of ``angle``.
    """
    if angle.dtype != jnp.float32:
        return jnp.sin(angle), jnp.cos(angle)
    quarter_turns = jnp.round(angle * (2.0 / jnp.pi))
    reduced = angle
    for part in _HALF_PI_PARTS:
        reduced = reduced - quarter_turns * part
    square = reduced * reduced
    sine = reduced + reduced * square * (
        -1.6666654611e-1 + square * (8.3321608736e-3 - square * 1.9515295891e-4)
    )
    cosine = 1.0 - square * (
        0.5
        - square
        * (4.166664568298827e-2 + square * (-1.388731625493765e-3 + square * 2.443315711809948e-5))
    )
    quadrant = quarter_turns - 4.0 * jnp.floor(quarter_turns * 0.25)
    odd = (quadrant == 1.0) | (quadrant == 3.0)
    sine_sign = jnp.where(quadrant >= 2.0, -1.0, 1.0)
    cosine_sign = jnp.where((quadrant == 1.0) | (quadrant == 2.0), -1.0, 1.0)
    return (sine_sign * jnp.where(odd, cosine, sine), cosine_sign * jnp.where(odd, sine, cosine))


@sincos.defjvp
def _sincos_jvp(
    primals: tuple[jax.Array], tangents: tuple[jax.Array]
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
    sine, cosine = sincos(primals[0])
    return (sine, cosine), (cosine * tangents[0], -sine * tangents[0])


@jax.custom_jvp
def arctan2(y: jax.Array, x: jax.Array) -> jax.Array:
    """The angle () of the point (x, y) in [-pi, pi], rad, without branches.

    One division and a short polynomial (the coefficients of the Cephes library's single-precision
    arctangent); the float32 error is below 5e-7. Float64 goes to the library function. The
    derivative is exact at distances of 0.01 or more from the origin, bounded by 100 closer to it,
    and zero at the origin.
    """
    if y.dtype != jnp.float32:
        return jnp.arctan2(y, x)
    high, low = jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.minimum(jnp.abs(x), jnp.abs(y))
    far = low > _TAN_EIGHTH * high
    below = jnp.where(far, low + high, high)
    ratio = jnp.where(far, low - high, low) / jnp.where(below == 0.0, 1.0, below)
    square = ratio * ratio
    angle = ratio + ratio * square * (
        -3.33329491539e-1
        + square * (1.99777106478e-1 + square * (-1.38776856032e-1 + square * 8.05374449538e-2))
    )
    angle = jnp.where(far, 0.25 * jnp.pi, 0.0) + angle
    angle = jnp.where(jnp.abs(y) > jnp.abs(x), 0.5 * jnp.pi - angle, angle)
    angle = jnp.where(x < 0.0, jnp.pi - angle, angle)
    return jnp.where(y < 0.0, -angle, angle)


@arctan2.defjvp
def _arctan2_jvp(
    primals: tuple[jax.Array, jax.Array], tangents: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    y, x = primals
    square = jnp.maximum(x * x + y * y, _LEAST_SQUARE)
    return arctan2(y, x), (x * tangents[0] - y * tangents[1]) / square
