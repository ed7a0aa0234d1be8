"""What is drawn for an episode: its start, disturbances, constants and track.

The sections ``start``, ``disturbance`` and ``randomization`` of a config;
``quadjax.race.episode`` draws from them.
"""

from collections.abc import Callable
from typing import Annotated, Any, Literal

from quadjax.core.sections import ORDERED, Field, OffAtZero, Section, Unit
from quadjax.core.traced import register
from quadjax.race.random_track import MAX_COORDINATE_M, RandomTracks
from quadjax.vehicle.protocol import VehicleModel

HalfWidth = Annotated[float, Field(ge=0, le=1e6)]
Moment = Annotated[float, Field(ge=-1e6, le=1e6)]
Share = Annotated[float, Field(ge=0, le=0.9)]
GROUND_STARTS_FRACTION = 0.1  # of the episodes, by default, where races start there


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
    along_leg: OffAtZero = Field(
        None,
        ge=0,
        le=1,
        description="farthest start on the way from the gate before to the target gate, as a "
        "fraction of it; the way is a cubic curve that leaves and enters the gates along their "
        "yaw; starts are uniform up to there; those that position puts past the gate are mirrored "
        "in its plane; null: all starts are at the gate before",
    )
    # None is the default of the description in a config, and no such start in ``RaceParams``.
    race: float | None = Field(
        None,
        ge=0,
        le=1,
        description="fraction of the episodes that begin as a race: at rest at the track's start "
        "(or in the last gate), x and y within 0.5 m, yaw within 45 deg; null: 0.1 where the "
        "track's start is on the ground, else 0",
    )
    position: Annotated[float, Unit("m")] = Field(
        0.5, ge=0, le=MAX_COORDINATE_M, description="half-width about the point on the leg, m"
    )
    velocity: Annotated[HalfWidth, Unit("m/s")] = Field(
        0.5, description="half-width of each component, m/s"
    )
    roll_pitch_deg: float = Field(
        40.0, ge=0, le=180, description="half-width of roll and pitch; above 89 with a quaternion"
    )
    yaw_deg: float = Field(180.0, ge=0, le=180, description="half-width of yaw about the heading")
    body_rates: Annotated[HalfWidth, Unit("1/s")] = Field(
        1.0, description="half-width of each component, rad/s"
    )
    thrust: Annotated[tuple[HalfWidth, HalfWidth], ORDERED] = Field(
        (7.4, 7.6), description="lowest and highest thrust, m/s^2; model rate"
    )


@register
class Disturbance(Section):
    """External disturbances, drawn per episode and constant in it."""

    moment_x: HalfWidth = Field(
        0.0, description="half-width, N m with model motor, else rad/s^2; the paper: 0.03"
    )
    moment_y: HalfWidth = Field(
        0.0, description="half-width, N m with model motor, else rad/s^2; the paper: 0.03"
    )
    moment_z: HalfWidth = Field(
        0.0, description="half-width, N m with model motor, else rad/s^2; the paper: 0.01"
    )
    force_z: HalfWidth = Field(0.0, description="half-width, m/s^2; the paper: 0.5")
    moment_bias: tuple[Moment, Moment, Moment] = Field(
        (0.0, 0.0, 0.0), description="moment added in every episode, in the unit of moment_x, body"
    )

    @property
    def half_widths(self) -> dict[str, float]:
        """The drawn ranges by name, without the bias: what scales the observation."""
        return {key: value for key, value in self.__dict__.items() if key != "moment_bias"}


@register
class Randomization(Section):
    """Domain randomization: largest relative error of each constant, drawn in every episode.

    A constant has the fraction of its group or that of ``all``, whichever is larger; that of
    ``all`` in a group that only a user's own vehicle model has.
    """

    all: Share = Field(0.0, description="every constant of the groups except gravity")
    gravity: Share = Field(0.0, description="g")
    inertia: Share = Field(0.0, description="moments of inertia")
    thrust: Share = Field(0.0, description="thrust coefficient, or mass")
    drag: Share = Field(0.0, description="drag coefficients")
    moment: Share = Field(0.0, description="roll and pitch moment coefficients")
    velocity_moment: Share = Field(0.0, description="moments of translational flight")
    yaw: Share = Field(0.0, description="yaw moment coefficients")
    lag: Share = Field(0.0, description="time constants")
    limits: Share = Field(0.0, description="lowest and highest commands or rotor speeds")
    motor_map: Share = Field(0.0, description="curvature of the motor map; models racing, a2rl")
    gyroscopic: Share = Field(0.0, description="gyroscopic coupling; model a2rl")
    aerodynamics: Share = Field(
        0.0, description="quadratic drag, angle of attack and advance; model a2rl"
    )
    constants: dict[str, Share] = Field(
        {},
        max_length=100,
        description="fractions of single constants, which override their group: {w_max: 0.15}",
    )

    population: str | None = Field(
        None,
        description="population of the model that all constants are drawn from, in place of "
        "fractions: all_racing_drones (model racing; arXiv 2504.21586), monorace_fastest or "
        "monorace_robust (model a2rl; arXiv 2601.15222)",
    )
    width: float = Field(
        1.0,
        ge=0,
        le=1,
        description="factor on all fractions, and on the difference between a drone of the "
        "population and the nominal one; schedule it for a curriculum",
    )
    tracks: RandomTracks | None = Field(
        None,
        description="random tracks, one of which is drawn for every training episode in place of "
        "track: count and the keys of track.generate; flights of evaluations are on "
        "track",
    )

    @property
    def drawn(self) -> bool:
        """Whether constants are drawn."""
        return any(v for key, v in self.__dict__.items() if key not in ("width", "tracks"))

    def by_constant(
        self, model: VehicleModel, larger: Callable[[Any, Any], Any] = max
    ) -> dict[str, Any]:
        """The fraction of each constant of a vehicle model; of leaves, with ``jnp.maximum``."""
        fractions = dict.fromkeys(model.constant_names, 0.0)
        for group, names in model.groups.items():
            lowest = 0.0 if group == "gravity" else self.all
            fractions |= dict.fromkeys(names, larger(getattr(self, group, 0.0), lowest))
        return {
            name: self.width * fraction for name, fraction in (fractions | self.constants).items()
        }
