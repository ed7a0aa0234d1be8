"""The openings of gates and their frames: what a step passes, and what it touches."""

import jax
import jax.numpy as jnp

from quadjax.core.gradients import Scalar
from quadjax.core.vectors import Vec3, safe_norm
from quadjax.race.track import Gate, to_opening_frame

SHORTEST_STEP_M = 1e-9  # of a step; a shorter one is along a plane


def inside_opening(relative: Vec3, g: Gate, inflation: Scalar) -> jax.Array:
    """Whether a position in the opening's frame is within the opening; the paper's test."""
    inside = (jnp.abs(relative.y) <= g.half_width + inflation) & (
        jnp.abs(relative.z) <= g.half_height + inflation
    )
    if g.circle is None:
        return inside
    distance, radius = safe_norm(relative.replace(x=jnp.zeros_like(relative.x))), g.half_width
    return jnp.where(g.circle, distance <= radius + inflation, inside)


def crossing(
    before: Vec3, after: Vec3, g: Gate, inflation: Scalar, test: str = "square"
) -> tuple[jax.Array, jax.Array]:
    """Whether a step passed the gate, and whether it hit it: two () bools.

    A gate is crossed when the position, m, world, goes from behind its plane to in front of it
    within one step. It is passed if a point is within the opening, which is wider by ``inflation``
    (), m, on each side: the first sample past the plane (``square``, as in the paper, and
    ``world_box``, as in the authors' code: |dx|, |dy|, |dz| below half a gate in world axes), or
    the point where the straight line between the two samples meets the plane (``interpolated``).
    """
    relative = to_opening_frame(g, after - g.position)
    behind = to_opening_frame(g, before - g.position)
    crossed = (behind.x < 0) & (relative.x >= 0)
    if test == "world_box":
        offset, width = after - g.position, g.half_width + inflation
        inside = (jnp.abs(offset.x) < width) & (jnp.abs(offset.y) < width)
        inside &= jnp.abs(offset.z) < g.half_height + inflation
    elif test == "interpolated":
        fraction = -behind.x / jnp.where(crossed, relative.x - behind.x, 1.0)
        inside = inside_opening(behind + fraction * (relative - behind), g, inflation)
    else:
        inside = inside_opening(relative, g, inflation)
    return crossed & inside, crossed & ~inside


def meets_opening(one: Vec3, other: Vec3, g: Gate, inflation: Scalar) -> jax.Array:
    """Whether a line between positions in the opening's frame is partly within the opening.

    By separating axes: those of the rectangle and the normal of the line.
    """
    middle, half = (one + other) * 0.5, (other - one) * 0.5
    width, height = g.half_width + inflation, g.half_height + inflation
    meets = jnp.abs(middle.y) <= width + jnp.abs(half.y)
    meets &= jnp.abs(middle.z) <= height + jnp.abs(half.z)
    aside = jnp.abs(middle.y * half.z - middle.z * half.y)
    meets &= aside <= width * jnp.abs(half.z) + height * jnp.abs(half.y)
    if g.circle is None:
        return meets
    along = -(middle.y * half.y + middle.z * half.z)
    along = along / jnp.maximum(half.y * half.y + half.z * half.z, SHORTEST_STEP_M**2)
    nearest = middle + half * along.clip(-1.0, 1.0)
    return jnp.where(g.circle, inside_opening(nearest, g, inflation), meets)


def touches_frame(
    before: Vec3, after: Vec3, g: Gate, inner: Scalar, outer: Scalar, depth: Scalar
) -> jax.Array:
    """Whether the straight line of a step touches the solid frame of a gate: a () bool.

    The frame is between the openings that are wider by ``inner`` and by ``outer`` (), m, on each
    side, up to ``depth`` (), m, from the gate's plane.
    """
    start = to_opening_frame(g, before - g.position)
    way = to_opening_frame(g, after - g.position) - start
    along_axis = jnp.where(jnp.abs(way.x) < SHORTEST_STEP_M, SHORTEST_STEP_M, way.x)
    # Of the part within the depth.
    middle, half = -start.x / along_axis, depth / jnp.abs(along_axis)
    first, last = jnp.maximum(middle - half, 0.0), jnp.minimum(middle + half, 1.0)
    ends = start + way * first, start + way * last
    passes = inside_opening(ends[0], g, inner) & inside_opening(ends[1], g, inner)
    solid = (first <= last) & (outer > inner)
    return solid & ~passes & meets_opening(*ends, g, outer)
