"""The interface between a vehicle's equations and the code that uses them.

A vehicle model is a ``VehicleModel``: its constants, commands and actuators by name and unit, and
pure methods of one drone (batch with ``jax.vmap``). World NED, body FRD, SI units, rad. The race,
the learners, the evaluation and the plant use only this interface, so a user's own model needs no
change to them.
"""

import dataclasses
import math
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Self

import jax
import numpy as np
from flax import struct

from quadjax.core import quaternion
from quadjax.core.frames import attitude, body_to_world, euler_rates, world_to_body
from quadjax.core.vectors import Vec3, from_unit
from quadjax.vehicle.constants import constant_names, declarations, from_values
from quadjax.vehicle.rigid_body import BodyState, RigidBodyState

Constants = Any  # a flax dataclass of scalars; see ``quadjax.vehicle.constants``
State = RigidBodyState
Command = Any  # a pytree of scalars, in the order of ``VehicleModel.commands``
Actuators = Any  # a pytree of scalars: propeller speeds, thrust, ...
Population = Callable[[Constants, jax.Array], Constants]
LEAST_SINGULAR_VALUE = 0.5  # of rows of unit length; below it, they are not independent
NO_EFFECT = 1e-3  # fraction of the strongest rotor's effect that is none


class Signal(NamedTuple):
    """A named group of scalars of a command or of the actuators."""

    name: str
    size: int
    unit: str


class VehicleParams(struct.PyTreeNode):
    """What a model is computed with; all of it traced.

    Attributes:
        constants: constants of the model.
        residual: a learned correction of the equations, where the model takes one.
        opaque_true: () bool, which affects the speed on CPUs only and can be ignored; see
            ``quadjax.core.materialize``. None: plain functions.
    """

    constants: Constants
    residual: Any = None
    opaque_true: jax.Array | None = None


class Motion(struct.PyTreeNode):
    """Rigid-body motion at the start of an episode."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    euler: Vec3  # roll, pitch, yaw, rad
    rates: Vec3  # p, q, r, rad/s, body


class Measurement(struct.PyTreeNode):
    """What is measured on board at one sample."""

    gyro: Vec3  # p, q, r, rad/s, body
    specific_force: Vec3  # accelerometer minus its bias, m/s^2, body
    actuators: Actuators  # propeller speeds, rpm, or the model's other actuator state
    body_velocity: Vec3  # m/s, body


@dataclasses.dataclass(frozen=True)
class VehicleModel:
    """A rigid body with actuators.

    A subclass gives ``name``, ``constants``, ``commands``, ``actuators`` and the methods
    ``command_range``, ``actuator_rate``, ``force_moment`` and ``hover_actuators``. It may
    replace any other, such as ``angular_acceleration`` or ``derivative``, and have a state of
    another type. Instances are compared and hashed where programs are compiled: a subclass with
    numbers is a frozen dataclass.

    Attributes:
        name: as in ``vehicle.model`` of a config and in a policy file.
        constants: flax dataclass of scalars; each number has a key in the vehicle file.
        commands: the command's numbers in order; an action has as many.
        actuators: the actuators' measured state, one group of the observation.
        populations: ``(nominal, numbers) -> constants`` by name, for ``randomization.population``:
            a drone of a population, of one number in [-1, 1] for each constant.
        moment_unit: unit of a moment: N m, or rad/s^2 where it is per inertia.
        has_battery: whether commands and actuators are propeller speeds, rpm, ``Rotors``, which a
            battery limits.
        has_residual: whether ``VehicleParams.residual`` is used.
        can_be_disturbed: whether there are external moments and forces, and ``angular_momentum``
            for their estimator.
        quaternion: whether the attitude is a quaternion, else Euler angles, which are singular at
            a pitch of 90 deg.
        disturbed: whether the state has an external moment and force.
    """

    name: ClassVar[str]
    constants: ClassVar[type]
    commands: ClassVar[tuple[Signal, ...]]
    actuators: ClassVar[Signal]
    populations: ClassVar[Mapping[str, Population]] = MappingProxyType({})
    moment_unit: ClassVar[str] = "N m"
    has_battery: ClassVar[bool] = False
    has_residual: ClassVar[bool] = False
    can_be_disturbed: ClassVar[bool] = False
    quaternion: bool = False
    disturbed: bool = False

    def command_range(self, c: Constants) -> tuple[Command, Command]:
        """Lowest and highest command."""
        raise NotImplementedError

    def actuator_range(self, c: Constants) -> tuple[Actuators, Actuators]:
        """Lowest and highest actuator state, observed as -1 and 1: by default as of commands."""
        return self.command_range(c)

    def actuator_rate(self, c: Constants, actuators: Actuators, command: Command) -> Actuators:
        """The derivative of the actuators' state under a command, 1/s."""
        raise NotImplementedError

    def force_moment(self, params: VehicleParams, body: BodyState) -> tuple[Vec3, Vec3]:
        """Specific force, m/s^2, and moment, ``moment_unit``, body."""
        raise NotImplementedError

    def angular_acceleration(
        self, c: Constants, moment: Vec3, rates: Vec3, command: Command
    ) -> Vec3:
        """The derivative of the body rates, rad/s^2: by default the moment per inertia."""
        return moment

    def hover_actuators(self, c: Constants) -> Actuators:
        """The actuators' state in hover, within its range."""
        raise NotImplementedError

    def start_actuators(
        self, c: Constants, numbers: jax.Array, thrust: tuple[jax.Array, jax.Array]
    ) -> Actuators:
        """The actuators' state at a start: drawn over their range; see ``start``."""
        low, high = self.actuator_range(c)
        pairs = zip(jax.tree.leaves(low), jax.tree.leaves(high), strict=True)
        values = [from_unit(*ends, numbers[index]) for index, ends in enumerate(pairs)]
        return jax.tree.unflatten(jax.tree.structure(low), values)

    def angular_momentum(
        self, c: Constants, actuators: Actuators, rates: Vec3
    ) -> tuple[Vec3, Vec3]:
        """Angular momentum minus that of the rotors, and the gyroscopic moment; see ``balance``.

        By default those per inertia of rotors without inertia: the rates and zero.
        """
        return rates, Vec3.zero()

    def thrust_to_weight(self, c: Constants) -> jax.Array | None:
        """Thrust at the highest command over weight; None: unknown."""
        return None

    def allocation(self, c: Constants) -> np.ndarray | None:
        """Thrust, roll, pitch and yaw (4, n) of each of n rotors alone; None: not checked."""
        return None

    def dependent_axes(self, c: Constants) -> str:
        """Why the rotors cannot set thrust, roll, pitch and yaw independently; "" if they can.

        By the signs of the allocation: rotors of different strength do not make an axis
        independent. The rank is that of rows of unit length, within ``LEAST_SINGULAR_VALUE``.
        """
        rows = self.allocation(c)
        if rows is None:
            return ""
        signs = np.sign(rows) * (np.abs(rows) > NO_EFFECT * np.abs(rows).max(axis=1, keepdims=True))
        length = np.maximum(np.linalg.norm(signs, axis=1, keepdims=True), 1.0)
        rank = np.linalg.matrix_rank(signs / length, LEAST_SINGULAR_VALUE)
        if rank == 4:
            return ""
        allowed = "all 4, as of neighbors that turn in opposite directions (turning)"
        return f"the rotors set only {rank} of thrust, roll, pitch and yaw, allowed: {allowed}"

    def derivative(self, params: VehicleParams, state: State, command: Command) -> State:
        """The time derivative of a state under a command, as a state."""
        c, actuators = params.constants, state.actuators
        a = attitude(state.attitude, opaque_true=params.opaque_true)
        velocity = world_to_body(a, state.velocity, opaque_true=params.opaque_true)
        rate = self.actuator_rate(c, actuators, command)
        body = BodyState(velocity, state.rates, actuators, rate)
        force, moment = self.force_moment(params, body)
        if state.moment_ext is not None and state.force_ext is not None:
            force, moment = force + state.force_ext, moment + state.moment_ext
        acceleration = body_to_world(a, force)
        return RigidBodyState(
            position=state.velocity,
            velocity=acceleration.replace(z=acceleration.z + c.g),
            attitude=euler_rates(a, state.rates),
            rates=self.angular_acceleration(c, moment, state.rates, command),
            actuators=rate,
            moment_ext=None if state.moment_ext is None else Vec3.zero(),
            force_ext=None if state.force_ext is None else Vec3.zero(),
        )

    def specific_force(self, params: VehicleParams, state: State) -> Vec3:
        """What an ideal accelerometer measures, m/s^2, body."""
        velocity = state.to_body(state.velocity)
        body = BodyState.steady(velocity, state.rates, state.actuators)
        force, _ = self.force_moment(params, body)
        return force if state.force_ext is None else force + state.force_ext

    def balance(self, params: VehicleParams, measured: Measurement) -> tuple[Vec3, Vec3, Vec3]:
        """The terms that the disturbance estimator compares.

        Returns:
            What is differentiated: angular momentum minus the part that rotor acceleration
            exchanges with the body, N m s; gyroscopic minus modeled moment, N m; measured minus
            modeled specific force, m/s^2. Moments are per inertia where ``moment_unit`` is.
        """
        actuators, rates = measured.actuators, measured.gyro
        momentum, gyroscopic = self.angular_momentum(params.constants, actuators, rates)
        # The moment of rotor acceleration is differentiated by the filter, not here.
        body = BodyState.steady(measured.body_velocity, rates, actuators)
        force, moment = self.force_moment(params, body)
        return momentum, gyroscopic - moment, measured.specific_force - force

    def measure(self, params: VehicleParams, state: State) -> Measurement:
        """What the drone measures, without noise."""
        force, velocity = self.specific_force(params, state), state.to_body(state.velocity)
        return Measurement(state.rates, force, state.actuators, velocity)

    def start(
        self, c: Constants, motion: Motion, numbers: jax.Array, thrust: tuple[jax.Array, jax.Array]
    ) -> State:
        """The start of an episode, without external disturbances.

        Of numbers (at least ``actuators.size``,), uniform in [-1, 1], and of the config's lowest
        and highest start thrust, m/s^2.
        """
        return self._at(motion, self.start_actuators(c, numbers, thrust))

    def hover(self, c: Constants, motion: Motion) -> State:
        """As ``start``, with the actuators of a hover."""
        return self._at(motion, self.hover_actuators(c))

    def _at(self, motion: Motion, actuators: Actuators) -> State:
        euler = quaternion.of_euler(motion.euler) if self.quaternion else motion.euler
        external = (Vec3.zero(), Vec3.zero()) if self.disturbed else (None, None)
        body = (motion.position, motion.velocity, euler, motion.rates, actuators)
        return RigidBodyState(*body, *external)

    @property
    def pitch_limit(self) -> float:
        """The largest pitch at which the state is valid, rad; inf if any."""
        return math.inf if self.quaternion else math.radians(89.0)

    def with_options(self, **options: bool) -> Self:
        """The model with other values of ``quaternion`` or ``disturbed``."""
        return dataclasses.replace(self, **options)

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
        groups: dict[str, tuple[str, ...]] = {}
        for name, declared in declarations(self.constants).items():
            if declared.group is not None:
                groups[declared.group] = (*groups.get(declared.group, ()), name)
        return groups

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
    def by_rotor(self) -> bool:
        """Whether commands and actuators are one number for each rotor, in the same order."""
        return len(self.commands) == 1 and self.action_size == self.actuators.size == 4

    @property
    def action_size(self) -> int:
        """Number of scalars of a command."""
        return sum(signal.size for signal in self.commands)
