"""The reward: the table ``REWARDS`` of its terms, their weights, and how they are combined."""

import collections
import functools
from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp

from quadjax.core.gradients import Scalar
from quadjax.core.imports import user_numbers
from quadjax.core.sections import Code, Field, Needs, OffAtZero, Section, Unit
from quadjax.core.traced import register
from quadjax.core.vectors import Vec3, safe_norm
from quadjax.race.layout import LAST_ACTION
from quadjax.race.memory import clipped_action
from quadjax.race.rules import HIT_A_GATE
from quadjax.race.track import Gate, to_gate_frame, to_opening_frame
from quadjax.race.types import Step, UserFunctions

Weight = Annotated[float, Field(ge=-1e6, le=1e6)]
Penalty = Annotated[float, Field(ge=0, le=1e6)]


@register
class Reward(Section):
    """Weights of the reward terms; the defaults are the published ones."""

    progress: Annotated[Weight, Unit("1/m")] = Field(
        1.0, description="reward per m of progress to the target gate"
    )
    gate: Weight = Field(10.0, description="reward per gate passed")
    gate_offset: Annotated[Weight, Unit("1/m")] = Field(
        10.0, description="penalty per m from the gate's center on passing"
    )
    collision: Weight = Field(10.0, description="penalty for a collision")
    time: Annotated[Weight, Unit("1/s")] = Field(0.0, description="penalty per s")
    body_rates: Weight = Field(0.0, description="penalty per s and rad/s of body rate")
    pitch_up: Annotated[Penalty, Unit("1/s")] = Field(
        0.0, description="penalty per s and rad of pitch (nose up)"
    )
    next_gate_progress: Annotated[Penalty, Unit("1/m")] = Field(
        0.0,
        description="reward per m of progress to the next gate within the step that passes a gate; "
        "equal to progress, a leg's reward does not depend on where its gates are passed",
    )
    gate_edge: Annotated[Penalty, Unit("1/m")] = Field(
        0.0,
        description="penalty per m of clearance violation, in a step that passes or hits a gate",
    )
    gate_edge_margin: Annotated[Penalty, Unit("m"), Needs("reward.gate_edge")] = Field(
        0.1, description="required clearance from each edge of a gate's opening, m"
    )
    gate_edge_reach: Annotated[Penalty, Unit("m"), Needs("reward.gate_edge")] = Field(
        1.0,
        description="the penalty is constant from this clearance violation on, in each axis, m; at "
        "least to the edge of a widened opening",
    )
    distance: OffAtZero = Field(
        None,
        ge=0,
        le=1e6,
        description="penalty per s and m of distance from the target gate's center; null: none",
    )
    action_change: OffAtZero = Field(
        None,
        ge=0,
        le=1e6,
        description="penalty per change of an action from step to step, each in -1 to 1, summed; "
        "null: none",
    )
    overspeed: Annotated[Penalty, Needs("rules.speed_limit")] = Field(
        20.0,
        description="penalty per s and m/s of speed above the margin below rules.speed_limit, as a "
        "multiple of reward.progress; above 1, flying faster gains less than it loses",
    )
    overspeed_margin: Annotated[float, Needs("rules.speed_limit")] = Field(
        0.03,
        ge=0,
        le=0.9,
        description="overspeed applies above 1 minus this fraction of rules.speed_limit",
    )
    terms: Annotated[dict[str, Weight], Code("{module:function: weight}")] = Field(
        {}, max_length=100, description="weights of your own reward terms, by module:function"
    )


def next_gate_progress(step: Step) -> jax.Array:
    """Progress () to the next gate's center, by way of this one's, m.

    For the step that passes the gate. With the weight of ``progress``, the rewards of a leg sum to
    the same wherever its gates are passed; without it, a leg that ends at a gate's edge has less.
    """
    relative = to_gate_frame(step.gate, step.position - step.gate.position)
    ahead = safe_norm(relative - step.gate.next_position)
    return step.distance_before + safe_norm(step.gate.next_position) - ahead


def clearance_violation(after: Vec3, g: Gate, margin: Scalar, reach: Scalar = 1.0) -> jax.Array:
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
    radial = jnp.clip(distance - (g.half_width - margin), 0.0, 2.0 * reach)
    return jnp.where(g.circle, radial, width + height)


def gate_edge(step: Step) -> jax.Array:
    """Minus the clearance violation () of the drone's edge at the target gate, m.

    For a step that passes the gate or hits one: crosses its plane outside the opening or, with
    ``rules.gate_frame``, touches the frame of any gate.
    """
    weights, inflation = step.params.reward, step.params.training_limits.gate_inflation
    margin = weights.gate_edge_margin + step.body_radius
    reach = jnp.maximum(weights.gate_edge_reach, inflation + margin)
    assert step.outcome is not None
    crossed = step.outcome.passed | step.outcome.crashes[HIT_A_GATE]
    violation = clearance_violation(step.position, step.gate, margin, reach)
    return jnp.where(crossed, -violation, 0.0)


def action_change(step: Step) -> jax.Array:
    """Minus the sum () of the absolute changes of the action's numbers, each within [-1, 1]."""
    assert step.action is not None
    pairs = zip(clipped_action(step.action), step.memories[LAST_ACTION], strict=True)
    changes = [jnp.abs(now - before) for now, before in pairs]
    return -functools.reduce(jnp.add, changes)


def overspeed(step: Step) -> Scalar:
    """Minus the speed () above the margin below the speed limit, m/s, times ``progress``'s weight.

    An episode's end has no gradient; with a weight above 1, flying faster gains less than it loses.
    """
    weights, limit = step.params.reward, step.params.rules.speed_limit
    if limit is None:
        return 0.0
    above = safe_norm(step.velocity) - (1.0 - weights.overspeed_margin) * limit
    return -weights.progress * jnp.maximum(above, 0.0)


class Term(NamedTuple):
    """A term of the reward: its weight is multiplied by ``value``, in the steps of ``when``.

    The reward of a step that passes a gate or ends in a crash replaces that of ``flight``; the
    terms of ``any step`` and ``per second`` are added in each.
    """

    value: Callable[[Step], Scalar]
    when: Literal["flight", "pass", "crash", "any step", "per second"] = "any step"


REWARDS: dict[str, Term] = {  # by the name of the weight, a field of ``Reward``
    # Ferede et al., arXiv 2311.16948, with the sign that makes progress positive.
    "progress": Term(lambda step: step.distance_before - step.distance, "flight"),
    "gate": Term(lambda step: 1.0, "pass"),
    "gate_offset": Term(lambda step: -step.distance, "pass"),
    "next_gate_progress": Term(next_gate_progress, "pass"),
    "collision": Term(lambda step: -1.0, "crash"),
    "gate_edge": Term(gate_edge),
    "action_change": Term(action_change),
    "time": Term(lambda step: -1.0, "per second"),
    "body_rates": Term(lambda step: -safe_norm(step.body_rates), "per second"),
    "pitch_up": Term(lambda step: -step.euler.y, "per second"),
    "distance": Term(lambda step: -step.distance, "per second"),
    "overspeed": Term(overspeed, "per second"),
}


def checked(name: str, term: Callable[[Step], jax.Array]) -> Term:
    """A user's own term, which is checked to give one number."""

    def value(step: Step) -> jax.Array:
        number = user_numbers(f"reward term {name}", term, step)[0]
        return jnp.asarray(number, jnp.result_type(step.time_step))

    return Term(value)


def reward(step: Step, user: UserFunctions = ()) -> jax.Array:
    """The reward () of one step: the sum of its weighted terms; see ``Term``.

    The step has its outcome and its action. A user's terms are added to ``REWARDS``. A term without
    a weight is not computed.
    """
    section, outcome = step.params.reward, step.outcome
    terms = REWARDS | {name: checked(name, term) for name, term in user}
    assert outcome is not None

    totals: dict[str, Scalar] = collections.defaultdict(float)  # by ``Term.when``
    for name, term in terms.items():
        weight = getattr(section, name) if name in REWARDS else section.terms.get(name)
        if weight is not None:
            totals[term.when] = totals[term.when] + weight * term.value(step)
    value = jnp.where(outcome.passed, totals["pass"], totals["flight"])
    value = jnp.where(outcome.crashed, totals["crash"], value)
    return value + totals["any step"] + step.time_step * totals["per second"]
