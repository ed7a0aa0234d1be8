"""The interface between a vehicle's equations and the code that uses them.

A vehicle model is a ``VehicleModel``: its constants, commands and actuators by name and unit, and
pure functions of one drone (batch with ``jax.vmap``). World NED, body FRD, SI units, rad. The race,
the learners, the evaluation and the plant use only this interface, so a user's own model needs no
change to them.
"""

import dataclasses
import math
import operator
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
from flax import struct

from quadjax.core import frames
from quadjax.core.frames import wrap_angle
from quadjax.core.vectors import Vec3

Scalar = jax.Array | float
Constants = Any  # a flax dataclass of scalars
State = Any  # a pytree of scalars
Command = Any  # a pytree of scalars, in the order of ``VehicleModel.commands``
Actuators = Any  # a pytree of scalars: propeller speeds, thrust, ...


class Signal(NamedTuple):
    """A named group of scalars of a command or of the actuators."""

    name: str
    size: int
    unit: str


@struct.dataclass
class VehicleParams:
    """What a model is computed with; all of it traced."""

    constants: Constants
    residual: Any = None  # a learned correction of the equations, where the model takes one


@struct.dataclass
class Motion:
    """Rigid-body motion at the start of an episode."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    euler: Vec3  # roll, pitch, yaw, rad
    rates: Vec3  # p, q, r, rad/s, body


@struct.dataclass
class Measurement:
    """What is measured on board at one sample."""

    gyro: Vec3  # p, q, r, rad/s, body
    specific_force: Vec3  # accelerometer minus its bias, m/s^2, body
    rpm: Actuators  # propeller speeds, rpm, or the model's other actuator state
    body_velocity: Vec3  # m/s, body


def _wrap(state: State) -> State:
    euler = state.euler
    return state.replace(euler=euler.replace(x=wrap_angle(euler.x), z=wrap_angle(euler.z)))


def _to_body(state: State, vector: Vec3) -> Vec3:
    return frames.world_to_body(frames.attitude(state.euler), vector)


def _no_hold(state: State, command: Command) -> State:
    return state


def _ignore_disturbance(state: State, moment: Vec3, force: Vec3) -> State:
    return state


@dataclasses.dataclass(frozen=True, eq=False)
class VehicleModel:
    """One vehicle model: data and pure functions of one drone.

    The defaults fit a state with the fields ``position``, ``velocity``, ``euler`` and ``rates`` (as
    in ``Motion``) that has no residual and no external disturbance. A model with another attitude
    (a quaternion, say) gives its own ``euler``, ``to_body`` and ``wrap``.

    Attributes:
        name: as in ``vehicle.model`` of a config and in a policy file.
        constants: flax dataclass of scalars; each field is a number of the vehicle file.
        commands: the command's numbers in order; an action has as many.
        actuators: the actuators' measured state, one group of the observation.
        derivative: ``(params, state, command, call) -> state``, the time derivative; ``call(f,
            *arguments)`` is ``f(*arguments)`` with its values computed once, and may be ignored.
        command_range: ``(constants) -> (lowest, highest)`` command.
        actuator_range: ``(constants) -> (lowest, highest)`` actuator state, observed as -1 and 1.
        actuator_state: ``(state) -> actuators``.
        start: ``(constants, motion, drawn, thrust) -> state``, the start of an episode, with
            ``drawn`` (at least ``actuators.size``,) uniform in [-1, 1] and the config's lowest and
            highest start thrust, m/s^2. External disturbances are zero.
        hover: ``(constants, motion) -> state``: as ``start``, with the actuators of a hover.
        specific_force: ``(params, state) -> Vec3``, what an ideal accelerometer measures, m/s^2,
            body.
        groups: names of constants by the group of ``randomization`` that scales them; a group is a
            key of that section. The group ``inertia`` is in the order x, y, z.
        populations: ``(nominal, drawn) -> constants`` by name, for ``randomization.population``: a
            drone of a population, of one number in [-1, 1] for each constant.
        positive: names of constants that must be above zero.
        nonnegative: names of constants that must not be negative.
        ranges: pairs of names of constants: 0 <= first < second.
        lags: names of the time constants, s.
        thrust_to_weight: ``(values by name) -> float``, or None where unknown.
        position, velocity, euler, rates: ``(state) -> Vec3``, as in ``Motion``.
        to_body: ``(state, vector) -> Vec3``: a world-frame vector in the body frame.
        wrap: ``(state) -> state`` with angles wrapped or a quaternion normalized, after each step.
        hold: ``(state, command) -> state``: called after each step with its command, for actuators
            without a lag.
        pitch_limit: rad; the largest pitch at which the state is valid, inf if any.
        uses_start_thrust: whether ``start`` uses the config's ``start.thrust``.
        has_battery: whether commands and actuators are propeller speeds, rpm, ``Rotors``, which a
            battery limits.
        has_residual: whether ``VehicleParams.residual`` is used.
        disturbance: ``(state) -> (moment, force)``: external moment, N m, and specific force,
            m/s^2, body; None where the model has none.
        with_disturbance: ``(state, moment, force) -> state``.
        balance: ``(params, measurement) -> (momentum, moment, force)`` for the disturbance
            estimator: what is differentiated, N m s; gyroscopic minus modeled moment, N m;
            measured minus modeled specific force, m/s^2. None where there is no estimator.
    """

    name: str
    constants: type
    commands: tuple[Signal, ...]
    actuators: Signal
    derivative: Callable[..., State]
    command_range: Callable[[Constants], tuple[Command, Command]]
    actuator_range: Callable[[Constants], tuple[Actuators, Actuators]]
    actuator_state: Callable[[State], Actuators]
    start: Callable[[Constants, Motion, jax.Array, tuple[jax.Array, jax.Array]], State]
    hover: Callable[[Constants, Motion], State]
    specific_force: Callable[[VehicleParams, State], Vec3]
    groups: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    populations: Mapping[str, Callable[[Constants, jax.Array], Constants]] = dataclasses.field(
        default_factory=dict
    )
    positive: tuple[str, ...] = ()
    nonnegative: tuple[str, ...] = ()
    ranges: tuple[tuple[str, str], ...] = ()
    lags: tuple[str, ...] = ()
    thrust_to_weight: Callable[[Mapping[str, float]], float] | None = None
    position: Callable[[State], Vec3] = operator.attrgetter("position")
    velocity: Callable[[State], Vec3] = operator.attrgetter("velocity")
    euler: Callable[[State], Vec3] = operator.attrgetter("euler")
    rates: Callable[[State], Vec3] = operator.attrgetter("rates")
    to_body: Callable[[State, Vec3], Vec3] = _to_body
    wrap: Callable[[State], State] = _wrap
    hold: Callable[[State, Command], State] = _no_hold
    pitch_limit: float = math.radians(89.0)
    uses_start_thrust: bool = False
    has_battery: bool = False
    has_residual: bool = False
    disturbance: Callable[[State], tuple[Vec3, Vec3]] | None = None
    with_disturbance: Callable[[State, Vec3, Vec3], State] = _ignore_disturbance
    balance: Callable[[VehicleParams, Measurement], tuple[Vec3, Vec3, Vec3]] | None = None

    @property
    def constant_names(self) -> tuple[str, ...]:
        """Names of the constants, in order."""
        return tuple(field.name for field in dataclasses.fields(self.constants))

    @property
    def action_size(self) -> int:
        """Number of scalars of a command."""
        return sum(signal.size for signal in self.commands)

    def measure(self, params: VehicleParams, state: State) -> Measurement:
        """What the drone measures, without noise."""
        velocity = self.to_body(state, self.velocity(state))
        force = self.specific_force(params, state)
        return Measurement(self.rates(state), force, self.actuator_state(state), velocity)
