"""The types of a race: ``RaceParams``, ``RaceState``, ``Outcome`` and ``Step``."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.gradients import Scalar
from quadjax.core.vectors import Vec3, safe_norm
from quadjax.race.draws import Disturbance, Randomization, Start
from quadjax.race.track import Gate, Track
from quadjax.vehicle.battery import Battery, BatteryState
from quadjax.vehicle.estimator import EstimatorParams
from quadjax.vehicle.protocol import Constants, State, VehicleModel, VehicleParams

if TYPE_CHECKING:  # what is declared next to the functions of a step
    from quadjax.race.rewards import Reward
    from quadjax.race.rules import Rules, TrainingLimits

# A user's functions of a step, with their names.
UserFunctions = tuple[tuple[str, Callable[["Step"], jax.Array]], ...]
# Numbers of the race from which those of a battery are computed.
BATTERY_CONSTANTS = tuple(f"vehicle.constants.{name}" for name in ("g", "k_w", "rpm_max", "tau"))


class RaceParams(struct.PyTreeNode):
    """Every number of the race, traced; and what of the config's sections chooses code.

    The numbers of the sections are leaves; their other values are static: ``rules.gate_test``,
    ``start.gate``, ``start.heading``, ``start.stagger_clocks`` and ``track.closed``. A number that
    is None is off: nothing is computed for it.
    """

    vehicle: VehicleParams
    track: Track
    reward: "Reward"
    rules: "Rules"
    training_limits: "TrainingLimits"
    start: Start
    disturbance: Disturbance
    randomization: Randomization
    tracks: Track | None = None  # random tracks, each leaf (tracks, gates); every episode draws one
    heading: jax.Array | None = None  # (gates,) rad, center of a start's yaw; None: north
    mismatch: Constants | None = None  # factors on the constants of the simulated drone
    estimator: EstimatorParams | None = None  # where the observation is estimated
    battery: Battery | None = None  # where it limits the commands
    delay: tuple[jax.Array, jax.Array] | None = None  # s, of commands: lowest and highest
    ranges: "PolicyRanges | None" = None  # None: those of the race's own vehicle
    observation_scale: jax.Array | None = None  # (layout.size,), in training; None: not scaled
    # () bool that is true, for the speed on CPUs only; see ``quadjax.core.materialize``.
    opaque_true: jax.Array | None = None

    def on_track(self, track: Track | None) -> "RaceParams":
        """The race on the track of one episode, if it has its own."""
        return self if track is None else self.replace(track=track)

    def vehicle_of(self, state: "RaceState") -> VehicleParams:
        """The vehicle of one episode, with the constants that were drawn for it."""
        if state.constants is None:
            return self.vehicle
        return dataclasses.replace(self.vehicle, constants=state.constants)


def describe_dependents(key: str, *, random_tracks: bool, battery: bool) -> str:
    """What is computed from a number of the race before training, with its verb; "": nothing."""
    if key == "rules.time_step":
        return "filters and limits are"
    if key == "rules.position_limit" and random_tracks:
        return "with randomization.tracks, the limit is"
    if battery and (key.startswith("battery.") or key in BATTERY_CONSTANTS):
        return "numbers of the battery are"
    return ""


class PolicyRanges(struct.PyTreeNode):
    """The ranges that a policy scales to [-1, 1], lowest and highest: those of its training."""

    observed: tuple[jax.Array, jax.Array]  # (layout.size,) each; no effect on what is not scaled
    commanded: tuple[jax.Array, jax.Array]  # (action_size,) each


class RaceState(struct.PyTreeNode):
    """One drone in its race."""

    drone: State  # of the vehicle model
    target: jax.Array  # () int32, index of the gate to pass next
    clock: jax.Array  # () int32, steps since the episode began
    gates_passed: jax.Array  # () int32
    constants: Constants | None  # of this episode, where they are drawn; else None
    # Values of ``quadjax.race.memory``, by name.
    memories: Mapping[str, Any] = struct.field(default_factory=dict)
    battery: BatteryState | None = None  # where the race has one
    delay: jax.Array | None = None  # () s, of this episode's commands, where there is one
    track: Track | None = None  # of this episode, where it is drawn; else None


class Memories(dict[str, Any]):
    """The values of a race's memories by name; another name is an error that says what to do."""

    def __missing__(self, name: str) -> Any:
        """Raise a ``LookupError``."""
        listed = ", ".join(self) or "none"
        remedy = "set the attribute memory of the function or field"
        raise LookupError(f"no memory {name!r}; this race has: {listed}; {remedy}")


class Outcome(struct.PyTreeNode):
    """The events of one step; every flag is a () bool."""

    passed: jax.Array  # the target gate, without a crash
    crashes: Mapping[str, jax.Array]  # by the name of the termination, whether it applies
    truncated: jax.Array
    finished: jax.Array | None = None  # passed the last gate of a course; None on a closed track
    # Names of all terminations by priority; ``crashes`` lacks those that the race does not have.
    names: tuple[str, ...] = struct.field(pytree_node=False, default=())

    @property
    def crashed(self) -> jax.Array:
        """Whether any termination applies: a collision, a limit, or a rule of the user."""
        return functools.reduce(jnp.logical_or, self.crashes.values())

    @property
    def over(self) -> jax.Array:
        """Whether a termination applies or the course is finished."""
        return self.crashed if self.finished is None else self.crashed | self.finished

    @property
    def crash_code(self) -> jax.Array:
        """The number (), from 1, of the first of ``names`` that applies; 0 where none does."""
        code = jnp.zeros((), jnp.int32)
        for index, name in reversed(list(enumerate(self.names, start=1))):
            if name in self.crashes:
                code = jnp.where(self.crashes[name], index, code)
        return code


class Step(struct.PyTreeNode):
    """One step of one drone in its race. World NED, body FRD, SI units, rad.

    A reward term is a function of a step that returns a () float, added to the reward with its
    weight (multiply by ``time_step`` for a reward per second). A rule is a function of a step
    that returns a () bool; true ends the episode, in training and in timed laps, as a collision
    does. The value of an ``ObservedField`` is a function of a step that returns its numbers. All
    must be pure and written with ``jax.numpy``.

    Attributes:
        model: the vehicle model, whose functions read ``before``, ``after`` and ``drone``.
        params: the numbers of the race.
        state: the race before the step, or the one that is observed: target, clock, gates passed.
        gate: the target gate.
        after: the vehicle's state after the step; None for an observation. For a reward term or a
            memory, a state that is not finite is replaced by the one before the step.
        outcome: events of the step, for a reward term or a memory (on a plant None for this); None
            for others.
        action: (action_size,) as the policy gave it, for a reward term or a memory; None for
            others.
    """

    model: VehicleModel = struct.field(pytree_node=False)
    params: RaceParams
    state: RaceState
    gate: Gate
    after: State | None = None
    outcome: Outcome | None = None
    action: jax.Array | None = None

    @property
    def memories(self) -> Mapping[str, Any]:
        """The values of the race's memories by name; see ``quadjax.race.memory``."""
        return Memories(self.state.memories)

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
        return self.drone.position

    @property
    def velocity(self) -> Vec3:
        """Velocity of ``drone``, m/s, world."""
        return self.drone.velocity

    @property
    def euler(self) -> Vec3:
        """Roll, pitch and yaw of ``drone``, rad."""
        return self.drone.euler

    @property
    def body_rates(self) -> Vec3:
        """Body rates of ``drone``, rad/s."""
        return self.drone.rates

    @functools.cached_property
    def distance(self) -> jax.Array:
        """Distance () of ``drone`` to the center of the target gate, m."""
        return safe_norm(self.position - self.gate.position)

    @functools.cached_property
    def distance_before(self) -> jax.Array:
        """Distance () to the center of the target gate before the step, m."""
        return safe_norm(self.before.position - self.gate.position)

    @property
    def body_radius(self) -> Scalar:
        """Radius of the drone, m; 0 for a point."""
        return 0.0 if self.params.rules.body_radius is None else self.params.rules.body_radius

    @property
    def time_step(self) -> Scalar:
        """Duration of the step (), s."""
        return self.params.rules.time_step
