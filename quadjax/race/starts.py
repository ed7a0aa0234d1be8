"""Where an episode starts: the section ``start`` of the config, and recorded states."""

from typing import Annotated, Literal

import jax
from flax import struct

from quadjax.core.sections import ORDERED, Field, Section, Unit
from quadjax.core.traced import register
from quadjax.vehicle.protocol import Motion

HalfWidth = Annotated[float, Field(ge=0, le=1e6)]
FROM_GROUND = 0.1  # default part of the episodes that begin on the ground, where races do


@register
class Start(Section):
    """The uniform distribution of an episode's start; the defaults are the paper's."""

    gate: Literal["first", "random"] = Field(
        "first", description="target of a start: the first gate or any; starts at the one before it"
    )
    heading: Literal["north", "inside_turn"] = Field(
        "north", description="center of the start's yaw: north, or to the inside of the turn"
    )
    stagger_clocks: bool = Field(
        False, description="start at a random step of the episode's clock, so that resets spread"
    )
    along_leg: float = Field(
        0.0,
        ge=0,
        le=1,
        description="farthest start on the way from the gate before to the target gate, as a "
        "fraction of it; the way is a cubic curve that leaves and enters the gates along their "
        "yaw; starts are uniform up to there",
    )
    # In a config, None is the default of the description. As a leaf, it is 0: no such start.
    race: float | None = Field(
        None,
        ge=0,
        le=1,
        description="part of the episodes that begin as a race: at rest at the track's start (or "
        "in the last gate), x and y within 0.5 m, yaw within 45 deg; null: 0.1 where the track's "
        "start is on the ground, else 0",
    )
    position: Annotated[HalfWidth, Unit("m")] = Field(
        0.5, description="half-width about the point on the leg, m"
    )
    velocity: Annotated[HalfWidth, Unit("m/s")] = Field(
        0.5, description="half-width of each component, m/s"
    )
    roll_pitch_deg: float = Field(40.0, ge=0, le=89, description="half-width of roll and pitch")
    yaw_deg: float = Field(180.0, ge=0, le=180, description="half-width of yaw about the heading")
    body_rates: Annotated[HalfWidth, Unit("1/s")] = Field(
        1.0, description="half-width of each component, rad/s"
    )
    thrust: Annotated[tuple[HalfWidth, HalfWidth], ORDERED] = Field(
        (7.4, 7.6), description="lowest and highest thrust, m/s^2; model rate"
    )


class RecordedStarts(struct.PyTreeNode):
    """States of flights in which a part of the episodes starts, each with the same chance."""

    motion: Motion  # components (n,); m, m/s, rad, rad/s
    actuators: jax.Array  # (n, k) in [-1, 1] over the range of what a start draws
    target: jax.Array  # (n,) int32, index of the gate to pass next
    fraction: jax.Array  # () of the episodes that start in one of them
