"""The rules of the race: the passing of gates, and the table ``TERMINATIONS`` of what ends it."""

import functools
import math
from collections.abc import Callable, Mapping
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp

from quadjax.core.gradients import Scalar
from quadjax.core.imports import user_numbers
from quadjax.core.sections import Code, Field, Needs, OffAtZero, Section, Unit
from quadjax.core.traced import register
from quadjax.core.vectors import safe_norm
from quadjax.race.openings import crossing, touches_frame
from quadjax.race.random_track import MAX_COORDINATE_M
from quadjax.race.track import Span, gate, gate_count
from quadjax.race.types import Outcome, Step, UserFunctions
from quadjax.vehicle.protocol import VehicleModel

Rate = Annotated[float, Field(gt=0, le=1e6)]
TAKEOFF_DEPTH_M = 0.5  # deepest position of a take-off: the ground itself is not simulated


@register
class Rules(Section):
    """The rules of the race, in training and evaluation."""

    time_step: float = Field(
        0.01, ge=1e-4, le=0.1, description="time between two commands and of the simulation, s"
    )
    gate_test: Literal["square", "world_box", "interpolated"] = Field(
        "square",
        description="what counts as passing: within the opening at the first sample past its plane "
        "(the paper), within a box along the world axes there (the authors' code), or within the "
        "opening where the line between two samples crosses the plane",
    )
    body_radius: OffAtZero = Field(
        None,
        ge=0,
        le=50,
        description="radius of the drone, m, by which openings, bounds and ground are closer; "
        "null: the drone is a point",
    )
    position_limit: float | None = Field(
        10.0, gt=0, le=MAX_COORDINATE_M, description="largest |x| and |y|, m; null: none"
    )
    bounds: tuple[Span, Span, Span] | None = Field(
        None,
        description="[lowest, highest] x, y and z, m: leaving the box is a collision; a z of -7 is "
        "a ceiling at 7 m; null: only position_limit and the ground",
    )
    ground_speed: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="largest speed within ground_height of the ground, m/s, so that races can "
        "start on it; null: touching the ground is a collision",
    )
    ground_height: Annotated[float, Needs("rules.ground_speed")] = Field(
        0.4, ge=0, le=100, description="height below which ground_speed applies, m"
    )
    gate_frame: OffAtZero = Field(
        None,
        ge=0,
        le=10,
        description="width of the solid frame around the opening of every gate, m, which the line "
        "between two samples may not touch; null: a collision only where the plane of the target "
        "gate is crossed outside its opening",
    )
    gate_depth: Annotated[float, Needs("rules.gate_frame")] = Field(
        0.1, gt=0, le=10, description="depth of the frames, half of it on each side, m"
    )
    body_rate_limit: Rate | tuple[Rate, Rate, Rate] | None = Field(
        1000.0,
        description="largest body rate about any axis, or [p, q, r] about each, rad/s; null: none",
    )
    speed_limit: float | None = Field(
        None, gt=0, le=1000, description="largest speed, m/s, above which a flight ends; null: none"
    )
    extra: Annotated[tuple[str, ...], Code()] = Field(
        (), max_length=32, description="your own rules that end an episode, as module:function"
    )


@functools.partial(register, whole_numbers=("episode_steps",))
class TrainingLimits(Section):
    """Limits of training; the exact rules have only the pitch at which a model is singular."""

    episode_steps: Annotated[int, Unit("steps")] = Field(
        1200, ge=1, le=10**6, description="time steps of an episode"
    )
    pitch_deg: float | None = Field(
        None,
        ge=1,
        le=89,
        description="largest |pitch|, deg; null: 85 for models with Euler angles, which are "
        "singular at 90, and none for those with quaternions",
    )
    roll_deg: float | None = Field(None, ge=1, le=180, description="largest |roll|, deg")
    yaw_rate: Annotated[float | None, Unit("1/s")] = Field(
        None, gt=0, le=1e6, description="largest |yaw rate|, rad/s"
    )
    gate_inflation: Annotated[float, Unit("m")] = Field(
        0.0,
        ge=-50,
        le=50,
        description="widening of every gate's opening on each side, m; negative: narrowing",
    )

    def largest_pitch_deg(self, model: VehicleModel) -> float | None:
        """The largest pitch in training with a vehicle model, deg; None: any."""
        if self.pitch_deg is None and math.isfinite(model.pitch_limit):
            return 85.0
        return self.pitch_deg


def pass_or_hit(step: Step) -> tuple[jax.Array, jax.Array]:
    """Whether a step passes its target gate, and whether it crosses the plane outside of it."""
    inflation, radius = step.params.training_limits.gate_inflation, step.params.rules.body_radius
    opening = inflation if radius is None else inflation - radius
    before, test = step.before.position, step.params.rules.gate_test
    return crossing(before, step.position, step.gate, opening, test)


def hits_a_gate(step: Step) -> jax.Array:
    """Whether the drone misses the opening of its gate, or its step touches a frame of any gate.

    Wider openings of the training do not move the outer edges of the frames.
    """
    rules, track, (_, hit) = step.params.rules, step.params.track, pass_or_hit(step)
    if rules.gate_frame is None:
        return hit
    wider = jnp.maximum(step.params.training_limits.gate_inflation, 0.0)
    touched, radius = jnp.zeros((), bool), step.body_radius
    sizes = wider - radius, rules.gate_frame + radius, 0.5 * rules.gate_depth + radius
    for index in range(gate_count(track)):
        line = step.before.position, step.position
        touched |= touches_frame(*line, gate(track, index), *sizes)
    return hit | touched


def hits_the_ground(step: Step) -> jax.Array:
    """Whether the position is below the ground, or, where it may land, the speed near it too high.

    Where the drone can take off from the ground, its radius does not matter.
    """
    rules, down = step.params.rules, step.position.z
    if rules.ground_speed is None:
        return down > 0.0 - step.body_radius  # 0.0 without a radius, not -0.0
    fast = (down > -rules.ground_height) & (safe_norm(step.velocity) > rules.ground_speed)
    return fast | (down > TAKEOFF_DEPTH_M)


def exceeds(*pairs: tuple[jax.Array, Scalar | None]) -> jax.Array | None:
    """Whether the magnitude of a number is above its limit; None where no number has a limit."""
    beyond = [jnp.abs(number) > limit for number, limit in pairs if limit is not None]
    return functools.reduce(jnp.logical_or, beyond) if beyond else None


def leaves_the_bounds(step: Step) -> jax.Array | None:
    """Whether |x|, |y| or the bounds of the race are exceeded."""
    rules, position, radius = step.params.rules, step.position, step.body_radius
    beyond = exceeds(*((x, rules.position_limit) for x in (position.x, position.y)))
    for x, (low, high) in zip(position.components(), rules.bounds or (), strict=False):
        outside = (x < low + radius) | (x > high - radius)
        beyond = outside if beyond is None else beyond | outside
    return beyond


def turns_too_fast(step: Step) -> jax.Array | None:
    """Whether a body rate is above the limit of the race."""
    limit, rates = step.params.rules.body_rate_limit, step.body_rates.components()
    return exceeds(*zip(rates, limit if isinstance(limit, tuple) else (limit,) * 3, strict=True))


def loses_attitude(step: Step) -> jax.Array | None:
    """Whether pitch or roll is above its limit of training, or the Euler angles are singular."""
    limits, euler = step.params.training_limits, step.euler
    angles = (euler.y, limits.pitch_deg), (euler.x, limits.roll_deg)
    return exceeds(*((x, None if deg is None else jnp.radians(deg)) for x, deg in angles))


class Termination(NamedTuple):
    """What ends an episode as a crash, and what to change if most flights of a training end so."""

    applies: Callable[[Step], jax.Array | None]  # None where the race has no such rule
    advice: str = ""


# By the text that says why. The first that applies is reported; a user's rules come after these.
HIT_A_GATE = "hit a gate"  # its plane crossed outside the opening, or a frame touched
NOT_FINITE = "not finite"
TERMINATIONS: dict[str, Termination] = {
    HIT_A_GATE: Termination(
        hits_a_gate,
        "raise reward.gate_edge or run.steps; for gates too close to each other to be passed, "
        "lower training_limits.gate_inflation",
    ),
    "hit the ground": Termination(
        hits_the_ground, "lower start.position and start.roll_pitch_deg, or raise the gates"
    ),
    "out of bounds": Termination(leaves_the_bounds, "raise rules.position_limit"),
    "above the body rate limit": Termination(
        turns_too_fast, "raise rules.body_rate_limit or reward.body_rates"
    ),
    "above the training limit of the yaw rate": Termination(
        lambda step: exceeds((step.body_rates.z, step.params.training_limits.yaw_rate)),
        "raise training_limits.yaw_rate",
    ),
    "lost its attitude": Termination(
        loses_attitude, "raise training_limits.pitch_deg, or lower vehicle.residual_gain"
    ),
    NOT_FINITE: Termination(
        lambda step: ~jnp.isfinite(sum(jax.tree.leaves(step.drone))),
        "check the constants of the vehicle: quadjax show FILE",
    ),
    "above the speed limit": Termination(
        lambda step: exceeds((safe_norm(step.velocity), step.params.rules.speed_limit)),
        "raise reward.overspeed or reward.overspeed_margin",
    ),
}


def terminations_of(rules: UserFunctions) -> Mapping[str, Termination]:
    """``TERMINATIONS`` and a user's own rules, each checked to give one flag."""

    def checked(name: str, rule: Callable[[Step], jax.Array]) -> Termination:
        return Termination(
            lambda step: jnp.asarray(user_numbers(f"rule {name}", rule, step)[0], bool)
        )

    return TERMINATIONS | {f"ended by {name}": checked(name, rule) for name, rule in rules}


def evaluate_rules(step: Step, user_rules: UserFunctions = ()) -> Outcome:
    """The events of a step, before any reset, by ``TERMINATIONS`` and a user's own rules."""
    params, state, terminations = step.params, step.state, terminations_of(user_rules)
    flags = {name: row.applies(step) for name, row in terminations.items()}
    crashes = {name: flag for name, flag in flags.items() if flag is not None}
    truncated = state.clock + 1 >= params.training_limits.episode_steps
    outcome = Outcome(pass_or_hit(step)[0], crashes, truncated, names=tuple(terminations))
    going = ~outcome.crashed
    outcome = outcome.replace(passed=outcome.passed & going, truncated=truncated & going)
    if params.track.closed:
        return outcome
    finished = outcome.passed & (state.target == gate_count(params.track) - 1)
    return outcome.replace(finished=finished, truncated=outcome.truncated & ~finished)
