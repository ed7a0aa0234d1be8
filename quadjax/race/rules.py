"""The rules of the race: gate crossing, collision, bounds, and the reward they give."""

import functools

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.gradients import Scalar
from quadjax.core.trigonometry import arctan2
from quadjax.core.vectors import Vec3, safe_norm
from quadjax.race.track import (
    Gate,
    Track,
    gate_at,
    gate_count,
    to_gate_frame,
    to_opening_frame,
)


@struct.dataclass
class Frame:
    """The solid frames of all gates."""

    width: jax.Array  # m, around the opening
    depth: jax.Array  # m, half of it on each side of the opening's plane


@struct.dataclass
class Landing:
    """Where slow flight near the ground is no collision."""

    height: jax.Array  # m above the ground
    speed: jax.Array  # m/s


@struct.dataclass
class Limits:
    """Where an episode ends."""

    time_step: jax.Array  # s
    episode_steps: jax.Array  # int32, a truncation
    position: jax.Array  # m, largest |x| and |y|
    body_rate: jax.Array  # rad/s, largest about any axis
    pitch: jax.Array  # rad; below pi/2, where the Euler angles are singular
    roll: jax.Array  # rad
    yaw_rate: jax.Array  # rad/s
    gate_inflation: jax.Array  # m added to each side of every gate's opening
    axis_rates: Vec3 | None = None  # rad/s, largest about each axis; None: body_rate alone
    bounds: tuple[Vec3, Vec3] | None = None  # lowest and highest position, m; None: none
    landing: Landing | None = None  # None: touching the ground is a collision
    frame: Frame | None = None  # None: only the target gate's plane is solid
    body_radius: jax.Array | None = None  # m, of the drone; None: a point
    speed: jax.Array | None = None  # m/s, the speed limit; None: none


@struct.dataclass
class Perception:
    """The penalty for a target gate out of the camera's view."""

    weight: jax.Array  # penalty per s and rad beyond the limit
    camera: jax.Array  # rad, upward tilt of the camera's axis from the body's x
    limit: jax.Array  # rad between the camera's axis and the gate's center


@struct.dataclass
class Overspeed:
    """The penalty for flying close to the speed limit, or above it."""

    weight: jax.Array  # multiple of the reward for progress
    limit: jax.Array  # m/s, the speed limit of the race
    margin: jax.Array  # of the limit, below which there is no penalty


@struct.dataclass
class RewardWeights:
    """The published reward, and further terms that are zero by default."""

    progress: jax.Array  # reward per m of progress to the target gate
    gate: jax.Array  # reward per gate passed
    gate_offset: jax.Array  # penalty per m from the gate's center, on passing it
    collision: jax.Array  # penalty for a collision
    time: jax.Array  # penalty per s
    body_rates: jax.Array  # penalty per s and rad/s of body rate
    pitch_up: jax.Array  # penalty per s and rad of pitch (nose up)
    next_gate_progress: jax.Array  # per m of progress to the next gate in the step that passes one
    gate_edge: jax.Array  # penalty per m of clearance violation on crossing a gate's plane
    gate_edge_margin: jax.Array  # required clearance from each edge of the opening, m
    gate_edge_reach: jax.Array  # largest clearance violation per axis, m
    action_change: jax.Array | None = None  # penalty per change of an action; None: none
    perception: Perception | None = None
    overspeed: Overspeed | None = None  # None: no speed limit


@struct.dataclass
class Outcome:
    """The events of one step; every flag is a () bool."""

    passed: jax.Array
    gate_collision: jax.Array
    ground: jax.Array
    out_of_bounds: jax.Array
    body_rate: jax.Array  # above the race's limit
    yaw_rate: jax.Array  # above the training limit
    attitude: jax.Array  # pitch or roll beyond its limit
    non_finite: jax.Array
    truncated: jax.Array
    extra_rule: jax.Array | None = None  # ended by a user's rule; None where there is none
    finished: jax.Array | None = None  # passed the last gate of a course; None on a closed track
    overspeed: jax.Array | None = None  # above the speed limit; None where there is none

    @property
    def terminated(self) -> jax.Array:
        """Whether the episode ended in a collision of any kind."""
        ended = self.gate_collision | self.ground | self.out_of_bounds | self.body_rate
        ended = ended | self.yaw_rate | self.attitude | self.non_finite
        for other in (self.extra_rule, self.overspeed):
            ended = ended if other is None else ended | other
        return ended

    @property
    def over(self) -> jax.Array:
        """Whether the episode ended by a collision or at the end of a course."""
        return self.terminated if self.finished is None else self.terminated | self.finished


def inside_square(relative: Vec3, g: Gate, inflation: jax.Array) -> jax.Array:
    """Whether a position in the opening's frame is within the opening; the paper's test."""
    inside = (jnp.abs(relative.y) <= g.half_width + inflation) & (
        jnp.abs(relative.z) <= g.half_height + inflation
    )
    if g.circle is None:
        return inside
    distance, radius = safe_norm(relative.replace(x=jnp.zeros_like(relative.x))), g.half_width
    return jnp.where(g.circle, distance <= radius + inflation, inside)


def inside_world_box(offset: Vec3, g: Gate, inflation: jax.Array) -> jax.Array:
    """The test of the authors' code: |dx|, |dy|, |dz| below half a gate in world axes."""
    return (
        (jnp.abs(offset.x) < g.half_width + inflation)
        & (jnp.abs(offset.y) < g.half_width + inflation)
        & (jnp.abs(offset.z) < g.half_height + inflation)
    )


def crossing(
    before: Vec3, after: Vec3, g: Gate, inflation: jax.Array, test: str = "square"
) -> tuple[jax.Array, jax.Array]:
    """Whether a step passed the gate, and whether it hit it: two () bools.

    A gate is crossed when the position goes from behind its plane to in front of it within one
    step. It is passed if a point is within the opening: the first sample past the plane
    (``square``, as in the paper, and ``world_box``, as in the authors' code), or the point where
    the straight line between the two samples meets the plane (``interpolated``).

    Args:
        before: position before the step, m, world.
        after: position after it.
        g: the target gate.
        inflation: () m added to each side of the opening; negative narrows it.
        test: ``square``, ``world_box`` or ``interpolated``; static.
    """
    relative = to_opening_frame(g, after - g.position)
    behind = to_opening_frame(g, before - g.position)
    crossed = (behind.x < 0) & (relative.x >= 0)
    if test == "world_box":
        inside = inside_world_box(after - g.position, g, inflation)
    elif test == "interpolated":
        fraction = -behind.x / jnp.where(crossed, relative.x - behind.x, 1.0)
        inside = inside_square(behind + fraction * (relative - behind), g, inflation)
    else:
        inside = inside_square(relative, g, inflation)
    return crossed & inside, crossed & ~inside


def inside_frame(
    position: Vec3,
    track: Track,
    frame: Frame,
    inflation: jax.Array,
    radius: jax.Array | float = 0.0,
) -> jax.Array:
    """Whether a drone touches the solid frame of any gate, a () bool.

    Args:
        position: m, world.
        track: all gates.
        frame: their width and depth.
        inflation: () m by which openings are wider; the outer edges do not change.
        radius: () m of the drone.
    """
    hit = jnp.zeros((), bool)
    for index in range(gate_count(track)):
        g = gate_at(track, index)
        relative = to_opening_frame(g, position - g.position)
        solid = ~inside_square(relative, g, inflation - radius)
        solid = solid & inside_square(relative, g, frame.width + radius)
        hit = hit | (solid & (jnp.abs(relative.x) <= 0.5 * frame.depth + radius))
    return hit


def too_fast(rates: Vec3, limits: Limits) -> jax.Array:
    """Whether body rates are above their limits, a () bool."""
    fastest = jnp.maximum(jnp.maximum(jnp.abs(rates.x), jnp.abs(rates.y)), jnp.abs(rates.z))
    beyond = fastest > limits.body_rate
    if limits.axis_rates is not None:
        for own, limit in zip(rates.components(), limits.axis_rates.components(), strict=True):
            beyond = beyond | (jnp.abs(own) > limit)
    return beyond


def outside_box(
    position: Vec3, bounds: tuple[Vec3, Vec3], radius: jax.Array | float = 0.0
) -> jax.Array:
    """Whether a drone of a radius, m, leaves the box between two corners, a () bool."""
    low, high = bounds
    sides = zip(position.components(), low.components(), high.components(), strict=True)
    out = [(x < least + radius) | (x > most - radius) for x, least, most in sides]
    return out[0] | out[1] | out[2]


BENEATH = 0.5  # m, deepest position of a take-off: the ground itself is not simulated


def hits_ground(
    position: Vec3, velocity: Vec3, landing: Landing | None, radius: jax.Array | float = 0.0
) -> jax.Array:
    """Whether a position or a velocity near the ground is a collision, a () bool.

    Where the drone can take off from the ground, its radius, m, does not matter.
    """
    if landing is None:
        return position.z > 0.0 - radius  # 0.0 without a radius, not -0.0
    fast = (position.z > -landing.height) & (safe_norm(velocity) > landing.speed)
    return fast | (position.z > BENEATH)


def next_gate_progress(before: Vec3, after: Vec3, g: Gate) -> jax.Array:
    """Progress () to the next gate's center, by way of this one's, m.

    For the step that passes ``g``. With the weight of ``progress``, the rewards of a leg sum to the
    same wherever its gates are passed; without it, a leg that ends at a gate's edge has less.
    """
    relative = to_gate_frame(g, after - g.position)
    ahead = safe_norm(relative - g.next_position)
    return safe_norm(before - g.position) + safe_norm(g.next_position) - ahead


def clearance_violation(after: Vec3, g: Gate, margin: jax.Array, reach: Scalar = 1.0) -> jax.Array:
    """Distance () beyond the required clearance from a gate's edges, m per axis, summed.

    Whether a gate is hit has no gradient; this has one at the crossing. It is at most ``reach`` in
    each axis.
    """
    relative = to_opening_frame(g, after - g.position)
    width = jnp.clip(jnp.abs(relative.y) - (g.half_width - margin), 0.0, reach)
    height = jnp.clip(jnp.abs(relative.z) - (g.half_height - margin), 0.0, reach)
    if g.circle is None:
        return width + height
    distance = safe_norm(relative.replace(x=jnp.zeros_like(relative.x)))
    return jnp.where(
        g.circle, jnp.clip(distance - (g.half_width - margin), 0.0, 2.0 * reach), width + height
    )


def perception_penalty(perception: Perception, seen: Vec3) -> jax.Array:
    """The penalty () per s of a gate's center ``seen`` in the body frame, m.

    ``weight`` times the angle beyond ``limit`` between it and the camera's axis, which is
    ``(cos c, 0, -sin c)`` with the camera's tilt ``c``.
    """
    cosine, sine = jnp.cos(perception.camera), jnp.sin(perception.camera)
    along = cosine * seen.x - sine * seen.z
    aside = Vec3(seen.y, sine * seen.x + cosine * seen.z, jnp.zeros_like(seen.y))
    angle = arctan2(safe_norm(aside), along)
    return perception.weight * jnp.maximum(angle - perception.limit, 0.0)


def overspeed_penalty(own: Overspeed, progress: Scalar, velocity: Vec3) -> jax.Array:
    """The penalty () per s of a speed near the limit: an episode's end has no gradient.

    ``weight progress (|v| - (1 - margin) limit)`` above that speed, where ``progress`` is the
    reward per m of progress: with a weight above 1, flying faster gains less than it loses.
    """
    above = safe_norm(velocity) - (1.0 - own.margin) * own.limit
    return own.weight * progress * jnp.maximum(above, 0.0)


def action_change(action: tuple[jax.Array, ...], before: tuple[jax.Array, ...]) -> jax.Array:
    """The sum () of the absolute changes of an action's numbers."""
    changes = [jnp.abs(now - old) for now, old in zip(action, before, strict=True)]
    return functools.reduce(jnp.add, changes)


def reward(
    weights: RewardWeights,
    outcome: Outcome,
    before: Vec3,
    after: Vec3,
    pitch: jax.Array,
    body_rates: Vec3,
    g: Gate,
    time_step: jax.Array,
    inflation: Scalar = 0.0,
) -> jax.Array:
    """The reward () of one step.

    - Passing a gate: ``gate - gate_offset |p - p_gate|``, and ``next_gate_progress`` times the
      progress of the step to the next gate.
    - A collision: ``-collision``.
    - Any other step: ``progress`` times the decrease of the distance to the target gate (Ferede et
      al., arXiv 2311.16948, with the sign that makes progress positive).

    On crossing a gate's plane, ``gate_edge`` per m of clearance violation is subtracted.

    Args:
        weights: of each term.
        outcome: events of the step.
        before: position before the step, m, world.
        after: position after it.
        pitch: after it, (), rad.
        body_rates: after it, rad/s.
        g: the target gate of the step.
        time_step: () s.
        inflation: () m added to each side of the openings.
    """
    distance = safe_norm(after - g.position)
    progress = weights.progress * (safe_norm(before - g.position) - distance)
    passed = weights.gate - weights.gate_offset * distance
    passed = passed + weights.next_gate_progress * next_gate_progress(before, after, g)
    value = jnp.where(outcome.passed, passed, progress)
    value = jnp.where(outcome.terminated, -weights.collision, value)
    reach = jnp.maximum(weights.gate_edge_reach, inflation + weights.gate_edge_margin)
    edge = weights.gate_edge * clearance_violation(after, g, weights.gate_edge_margin, reach)
    value = value - jnp.where(outcome.passed | outcome.gate_collision, edge, 0.0)
    turning = weights.body_rates * safe_norm(body_rates)
    return value - time_step * (weights.time + turning + weights.pitch_up * pitch)
