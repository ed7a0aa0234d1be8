"""The minimum of each leg of the relaxation, for given multipliers; see ``quadjax.limits.bound``.

docs/design/limits.md has the equations.
"""

import functools

import jax
import jax.numpy as jnp
from flax import struct

PIECES = 64  # of a leg's multiplier


@struct.dataclass
class Numbers:
    """What the minima of the legs are computed from."""

    force: jax.Array
    drag: jax.Array
    gravity: jax.Array  # (3,)
    starts: jax.Array  # (legs, corners, 3) m
    ends: jax.Array


def _multipliers(
    periodic: bool, stops: bool, count: int, x: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Multipliers (legs, 3): velocity at each leg's start and end, position at start and end."""
    size = 3 * count
    velocity, position = x[:size].reshape(-1, 3), x[size : 2 * size].reshape(-1, 3)
    if periodic:
        first_velocity, first_position = velocity[-1], position[-1]
    else:
        first_velocity, first_position = x[2 * size :], jnp.zeros(3)
        position = position.at[-1].set(0.0)
        if not stops:
            velocity = velocity.at[-1].set(0.0)
    before = (
        jnp.concatenate([first[None], each[:-1]])
        for first, each in ((first_velocity, velocity), (first_position, position))
    )
    start_velocity, start_position = before
    return start_velocity, velocity, start_position, position


@functools.partial(jax.jit, static_argnames=("periodic", "stops"))
@functools.partial(jax.value_and_grad, argnums=3)
def softened(
    periodic: bool,
    stops: bool,
    numbers: Numbers,
    x: jax.Array,
    softness: jax.Array,
    grid: jax.Array,
) -> jax.Array:
    """Minus the sum of the legs' smoothed minima over durations (legs, n); with its gradient."""
    sides = _multipliers(periodic, stops, len(grid), x)
    values = _values(numbers, sides, grid).reshape(len(grid), -1)
    return softness * jax.nn.logsumexp(-values / softness, axis=1).sum()


@functools.partial(jax.jit, static_argnames=("periodic", "stops"))
def cells(
    periodic: bool,
    stops: bool,
    numbers: Numbers,
    x: jax.Array,
    low: jax.Array,
    high: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The values in the middle of cells of durations, and bounds of their slopes."""
    sides = _multipliers(periodic, stops, len(low), x)
    values = _values(numbers, sides, 0.5 * (low + high))
    return values, _steepest(numbers, sides, low, high)


def _support(mass: Numbers, direction: jax.Array) -> jax.Array:
    """The largest ``-direction . (g + f)`` over the forces ``f``."""
    length = jnp.sqrt(jnp.sum(direction * direction, axis=-1) + 1e-18)
    return mass.force * length - direction @ mass.gravity


def _values(mass: Numbers, sides: tuple[jax.Array, ...], times: jax.Array) -> jax.Array:
    """Lower bounds (legs, times, pairs of corners) of each leg's minimum at durations, s."""
    first, last, here, there = sides
    change = last - first
    share = jnp.linspace(0.0, 1.0, PIECES + 1)
    support = _support(mass, first[:, None] + share[:, None] * change[:, None])
    growth = jnp.expm1(mass.drag * times)[..., None]
    when = jnp.log1p(share * growth) / mass.drag  # s, when the multiplier has changed by `share`
    # The support is convex: its chords are above it, and are integrated exactly.
    width = jnp.diff(when, axis=-1)
    moment = share[1:] - share[:-1]
    mean = moment / mass.drag - width / growth  # the integral of `share` over a piece, s
    slope = jnp.diff(support, axis=-1)[:, None] / moment
    lost = (support[:, None, :-1] - slope * share[:-1]) * width + slope * mean
    way = mass.ends[:, None, :, :] - mass.starts[:, :, None, :]
    pull = jnp.einsum("lc,labc->lab", change, way)[:, None] / growth[..., None]
    push = jnp.einsum("lc,labc->lab", first, way)[:, None]
    place = jnp.einsum("lc,lbc->lb", there, mass.ends)[:, None, None, :]
    place = place - jnp.einsum("lc,lac->la", here, mass.starts)[:, None, :, None]
    values = (times - lost.sum(axis=-1))[..., None, None] + mass.drag * (pull - push) + place
    return values.reshape(*times.shape, -1)


def _steepest(
    mass: Numbers, sides: tuple[jax.Array, ...], low: jax.Array, high: jax.Array
) -> jax.Array:
    """An upper bound (legs, cells) of the slope of ``_values`` over cells of durations."""
    first, last, _, _ = sides
    change = jnp.linalg.norm(last - first, axis=1)[:, None]
    way = mass.ends[:, None, :, :] - mass.starts[:, :, None, :]
    farthest = jnp.abs(jnp.einsum("lc,labc->lab", last - first, way)).max(axis=(1, 2))[:, None]
    inverse = jnp.exp(mass.drag * low) / jnp.expm1(mass.drag * low) ** 2
    ends = jnp.stack([_support(mass, first), _support(mass, last)])
    direct = jnp.abs(1.0 - ends).max(axis=0)[:, None]
    reach = (mass.force + jnp.linalg.norm(mass.gravity)) * change
    return direct + reach * (mass.drag * high + 1.0) + mass.drag**2 * farthest * inverse
