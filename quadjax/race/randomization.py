"""What differs from episode to episode: external disturbances, constants and tracks."""

from typing import Annotated

from quadjax.core.sections import Field, Section
from quadjax.core.traced import register
from quadjax.race.random_track import RandomTracks
from quadjax.race.starts import HalfWidth
from quadjax.race.track import Coordinate
from quadjax.vehicle.protocol import VehicleModel

Share = Annotated[float, Field(ge=0, le=0.9)]


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
    moment_bias: tuple[Coordinate, Coordinate, Coordinate] = Field(
        (0.0, 0.0, 0.0), description="moment added in every episode, in the unit of moment_x, body"
    )

    @property
    def half_widths(self) -> dict[str, float]:
        """The drawn ranges by name, without the bias: what scales the observation."""
        return {key: value for key, value in self.__dict__.items() if key != "moment_bias"}


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

    def by_constant(self, model: VehicleModel) -> dict[str, float]:
        """The fraction of each constant of a vehicle model."""
        fractions = dict.fromkeys(model.constant_names, 0.0)
        for group, names in model.groups.items():
            lowest = 0.0 if group == "gravity" else self.all
            fractions |= dict.fromkeys(names, max(getattr(self, group, 0.0), lowest))
        return {
            name: self.width * fraction for name, fraction in (fractions | self.constants).items()
        }
