"""``Step``: the argument of every reward term, termination and field of the observation."""

import dataclasses
import functools
from typing import TYPE_CHECKING

import jax

from quadjax.core.gradients import Scalar
from quadjax.core.vectors import Vec3, safe_norm
from quadjax.race.track import Gate
from quadjax.vehicle.protocol import State, VehicleModel

if TYPE_CHECKING:
    from quadjax.race.environment import RaceParams, RaceState
    from quadjax.race.rules import Outcome


@dataclasses.dataclass(frozen=True)
class Step:
    """One step of one drone in its race. World NED, body FRD, SI units, rad.

    A reward term is a function of it that returns a () float, added to the step's reward with its
    weight (multiply by ``time_step`` for a reward per second). A rule is a function of it that
    returns a () bool; true ends the episode, in training and in timed laps, as a collision does.
    The value of an observed ``Field`` is a function of it that returns the field's numbers. All
    must be pure and written with ``jax.numpy``.

    Attributes:
        model: the vehicle model, whose functions read ``before``, ``after`` and ``drone``.
        params: the numbers of the race.
        state: the race before the step, or the one that is observed: target, clock, gates passed.
        gate: the target gate.
        after: the vehicle's state after the step; None for an observation.
        outcome: events of the step, for a reward term; None for others.
        action: (action_size,) as the policy gave it, for a reward term; None for others.
    """

    model: VehicleModel
    params: "RaceParams"
    state: "RaceState"
    gate: Gate
    after: State | None = None
    outcome: "Outcome | None" = None
    action: jax.Array | None = None

    @property
    def before(self) -> State:
        """The vehicle's state before the step."""
        return self.state.drone

    @property
    def drone(self) -> State:
        """The vehicle's state after the step, or the one that is observed."""
        return self.state.drone if self.after is None else self.after

    @property
    def position(self) -> Vec3:
        """Position of ``drone``, m, world."""
        return self.model.position(self.drone)

    @property
    def velocity(self) -> Vec3:
        """Velocity of ``drone``, m/s, world."""
        return self.model.velocity(self.drone)

    @property
    def euler(self) -> Vec3:
        """Roll, pitch and yaw of ``drone``, rad."""
        return self.model.euler(self.drone)

    @property
    def body_rates(self) -> Vec3:
        """Body rates of ``drone``, rad/s."""
        return self.model.rates(self.drone)

    @functools.cached_property
    def distance(self) -> jax.Array:
        """Distance () of ``drone`` to the center of the target gate, m."""
        return safe_norm(self.position - self.gate.position)

    @functools.cached_property
    def distance_before(self) -> jax.Array:
        """Distance () to the center of the target gate before the step, m."""
        return safe_norm(self.model.position(self.before) - self.gate.position)

    @property
    def time_step(self) -> Scalar:
        """Duration of the step (), s."""
        return self.params.rules.time_step
