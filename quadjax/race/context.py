"""The argument of own reward terms and rules."""

import dataclasses
from typing import TYPE_CHECKING

import jax

from quadjax.core.vectors import Vec3
from quadjax.race.rules import Outcome
from quadjax.race.track import Gate
from quadjax.vehicle.protocol import State, VehicleModel

if TYPE_CHECKING:
    from quadjax.race.environment import RaceParams, RaceState


@dataclasses.dataclass(frozen=True)
class StepContext:
    """One step of one drone in its race. World NED, body FRD, SI units, rad.

    A reward term is a function of it that returns a () float, added to the step's reward with its
    weight (multiply by ``time_step`` for a reward per second). A rule is a function of it that
    returns a () bool; true ends the episode, in training and in timed laps, as a collision does.
    Both must be pure and written with ``jax.numpy``.

    Attributes:
        model: the vehicle model, whose functions read ``before`` and ``after``.
        params: the numbers of the race.
        state: the race before the step: target, clock, gates passed.
        after: the vehicle's state after the step.
        gate: the target gate of the step.
        outcome: events of the step, for a reward term; None for a rule.
        action: (action_size,) as the policy gave it, for a reward term; None for a rule.
    """

    model: VehicleModel
    params: "RaceParams"
    state: "RaceState"
    after: State
    gate: Gate
    outcome: Outcome | None = None
    action: jax.Array | None = None

    @property
    def before(self) -> State:
        """The vehicle's state before the step."""
        return self.state.drone

    @property
    def position(self) -> Vec3:
        """Position after the step, m, world."""
        return self.model.position(self.after)

    @property
    def velocity(self) -> Vec3:
        """Velocity after the step, m/s, world."""
        return self.model.velocity(self.after)

    @property
    def euler(self) -> Vec3:
        """Roll, pitch and yaw after the step, rad."""
        return self.model.euler(self.after)

    @property
    def body_rates(self) -> Vec3:
        """Body rates after the step, rad/s."""
        return self.model.rates(self.after)

    @property
    def time_step(self) -> jax.Array:
        """Duration of the step (), s."""
        return self.params.limits.time_step
