"""The interface between a vehicle's equations and the code that uses them.

A vehicle model is a ``VehicleModel``: its constants, commands and actuators by name and unit, and
pure functions of one drone (batch with ``jax.vmap``). World NED, body FRD, SI units, rad. The race,
the learners, the evaluation and the plant use only this interface, so a user's own model needs no
change to them.
"""

import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import jax
from flax import struct

from quadjax.core.errors import InputError
from quadjax.core.vectors import Vec3
from quadjax.vehicle.constants import constant_names, declarations, from_values

Constants = Any  # a flax dataclass of scalars; see ``quadjax.vehicle.constants``
State = Any  # a pytree of scalars
Command = Any  # a pytree of scalars, in the order of ``VehicleModel.commands``
Actuators = Any  # a pytree of scalars: propeller speeds, thrust, ...
Population = Callable[[Constants, jax.Array], Constants]


class Signal(NamedTuple):
    """A named group of scalars of a command or of the actuators."""

    name: str
    size: int
    unit: str


@struct.dataclass
class VehicleParams:
    """What a model is computed with; all of it traced.

    Attributes:
        constants: of the model.
        residual: a learned correction of the equations, where the model takes one.
        opaque_true: () bool with which a model computes values once; see
            ``quadjax.core.materialize``. None: plain functions.
    """

    constants: Constants
    residual: Any = None
    opaque_true: jax.Array | None = None


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


class VehicleModel:
    """One vehicle model: a subclass gives what the equations need, and may keep the rest.

    Most models are a ``quadjax.vehicle.rigid_body.RigidBody``, which implements all but a few
    methods. Instances are compared and hashed where programs are compiled: equal ones must have
    equal equations.

    Attributes:
        name: as in ``vehicle.model`` of a config and in a policy file.
        constants: flax dataclass of scalars; each number has a key in the vehicle file.
        commands: the command's numbers in order; an action has as many.
        actuators: the actuators' measured state, one group of the observation.
        populations: ``(nominal, drawn) -> constants`` by name, for ``randomization.population``: a
            drone of a population, of one number in [-1, 1] for each constant.
        uses_start_thrust: whether ``start`` uses the config's ``start.thrust``.
        has_battery: whether commands and actuators are propeller speeds, rpm, ``Rotors``, which a
            battery limits.
        has_residual: whether ``VehicleParams.residual`` is used.
        has_estimator: whether ``balance`` is defined, for the disturbance estimator.
        can_be_disturbed: whether ``with_disturbances`` is defined.
        disturbed: whether the state has an external moment and force.
        moment_unit: of an external moment.
    """

    name: ClassVar[str]
    constants: ClassVar[type]
    commands: ClassVar[tuple[Signal, ...]]
    actuators: ClassVar[Signal]
    populations: ClassVar[Mapping[str, Population]] = MappingProxyType({})
    uses_start_thrust: ClassVar[bool] = False
    has_battery: ClassVar[bool] = False
    has_residual: ClassVar[bool] = False
    has_estimator: ClassVar[bool] = False
    can_be_disturbed: ClassVar[bool] = False
    moment_unit: ClassVar[str] = "N m"
    disturbed: bool = False

    def derivative(self, params: VehicleParams, state: State, command: Command) -> State:
        """The time derivative of a state under a command, as a state."""
        raise NotImplementedError

    def command_range(self, c: Constants) -> tuple[Command, Command]:
        """Lowest and highest command."""
        raise NotImplementedError

    def actuator_range(self, c: Constants) -> tuple[Actuators, Actuators]:
        """Lowest and highest actuator state, observed as -1 and 1."""
        raise NotImplementedError

    def actuator_state(self, state: State) -> Actuators:
        """The actuators' state."""
        raise NotImplementedError

    def start(
        self, c: Constants, motion: Motion, drawn: jax.Array, thrust: tuple[jax.Array, jax.Array]
    ) -> State:
        """The start of an episode, without external disturbances.

        Args:
            c: the constants.
            motion: of the body.
            drawn: numbers (at least ``actuators.size``,) uniform in [-1, 1].
            thrust: the config's lowest and highest start thrust, m/s^2.
        """
        raise NotImplementedError

    def hover(self, c: Constants, motion: Motion) -> State:
        """As ``start``, with the actuators of a hover."""
        raise NotImplementedError

    def specific_force(self, params: VehicleParams, state: State) -> Vec3:
        """What an ideal accelerometer measures, m/s^2, body."""
        raise NotImplementedError

    def position(self, state: State) -> Vec3:
        """Position, m, world."""
        raise NotImplementedError

    def velocity(self, state: State) -> Vec3:
        """Velocity, m/s, world."""
        raise NotImplementedError

    def euler(self, state: State) -> Vec3:
        """Roll, pitch and yaw, rad."""
        raise NotImplementedError

    def rates(self, state: State) -> Vec3:
        """Body rates p, q, r, rad/s."""
        raise NotImplementedError

    def to_body(self, state: State, vector: Vec3) -> Vec3:
        """A world-frame vector in the body frame."""
        raise NotImplementedError

    def wrap(self, state: State) -> State:
        """The state with angles wrapped or a quaternion normalized, after each step."""
        return state

    def hold(self, state: State, command: Command) -> State:
        """The state with actuators that follow the command without a lag; after each step."""
        return state

    def thrust_to_weight(self, c: Constants) -> float | None:
        """Thrust at the highest command over weight; None: unknown."""
        return None

    @property
    def pitch_limit(self) -> float:
        """The largest pitch at which the state is valid, rad; inf if any."""
        return math.radians(89.0)

    def with_quaternions(self) -> Self:
        """The model whose attitude is a quaternion, so that any attitude is valid."""
        raise InputError(f"vehicle.quaternion is true, allowed: false with model {self.name}")

    def with_disturbances(self) -> Self:
        """The model whose state has an external moment and force."""
        raise InputError(f"disturbance: the model {self.name} has none")

    def disturbance(self, state: State) -> tuple[Vec3, Vec3]:
        """External moment, ``moment_unit``, and specific force, m/s^2, body."""
        raise NotImplementedError

    def with_disturbance(self, state: State, moment: Vec3, force: Vec3) -> State:
        """The state with an external moment and force, as of ``disturbance``."""
        raise NotImplementedError

    def balance(self, params: VehicleParams, measured: Measurement) -> tuple[Vec3, Vec3, Vec3]:
        """The terms that the disturbance estimator compares.

        Returns:
            What is differentiated: angular momentum minus the part that rotor acceleration
            exchanges with the body, N m s; gyroscopic minus modeled moment, N m; measured minus
            modeled specific force, m/s^2. Moments are per inertia where ``moment_unit`` is.
        """
        raise NotImplementedError

    def measure(self, params: VehicleParams, state: State) -> Measurement:
        """What the drone measures, without noise."""
        velocity = self.to_body(state, self.velocity(state))
        force = self.specific_force(params, state)
        return Measurement(self.rates(state), force, self.actuator_state(state), velocity)

    def make_constants(self, values: Mapping[str, Any]) -> Constants:
        """The constants with numbers by name."""
        return from_values(self.constants, values)

    @property
    def constant_names(self) -> tuple[str, ...]:
        """Names of the constants, in order."""
        return constant_names(self.constants)

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Names of the constants of each group of ``randomization``."""
        found: dict[str, tuple[str, ...]] = {}
        for name, declared in declarations(self.constants).items():
            if declared.group is not None:
                found[declared.group] = (*found.get(declared.group, ()), name)
        return found

    @property
    def ranges(self) -> tuple[tuple[str, str], ...]:
        """Pairs of names of constants: 0 <= first < second."""
        pairs = declarations(self.constants).items()
        return tuple((x.above, name) for name, x in pairs if x.above is not None)

    @property
    def lags(self) -> tuple[str, ...]:
        """Names of the time constants, s."""
        return self.groups.get("lag", ())

    @property
    def action_size(self) -> int:
        """Number of scalars of a command."""
        return sum(signal.size for signal in self.commands)
