"""A rigid body with actuators: the kinematics that all shipped vehicle models have in common.

A model adds its constants, its actuators and its forces. World NED, body FRD. Rotors: 1 front-left,
2 front-right, 3 rear-right, 4 rear-left.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any, Self

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import quaternion
from quadjax.core.frames import attitude, body_to_world, euler_rates, world_to_body, wrap_angle
from quadjax.core.materialize import call_materialized_forward
from quadjax.core.quaternion import Quaternion
from quadjax.core.trigonometry import arctan2
from quadjax.core.vectors import Vec3, between
from quadjax.vehicle.protocol import (
    Actuators,
    Command,
    Constants,
    Measurement,
    Motion,
    VehicleModel,
    VehicleParams,
)


@struct.dataclass
class RigidBodyState:
    """State of one drone."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    euler: Vec3 | Quaternion  # roll, pitch, yaw, rad, or a quaternion from body to world
    rates: Vec3  # p, q, r, rad/s, body
    actuators: Actuators  # rotor speeds or thrusts
    moment_ext: Vec3 | None = None  # external moment, N m or rad/s^2, body
    force_ext: Vec3 | None = None  # external specific force, m/s^2, body


@dataclasses.dataclass(frozen=True)
class RigidBody(VehicleModel):
    """A rigid body with actuators; a subclass gives forces, moments and actuators.

    Attributes:
        quaternion: whether the attitude is a quaternion, else Euler angles, which are singular at
            a pitch of 90 deg.
        disturbed: whether the state has an external moment and force.
    """

    quaternion: bool = False
    disturbed: bool = False

    def actuator_rate(self, c: Constants, actuators: Actuators, command: Command) -> Actuators:
        """The derivative of the actuators' state under a command."""
        raise NotImplementedError

    def force_moment(
        self,
        params: VehicleParams,
        actuators: Actuators,
        actuator_rate: Actuators,
        velocity: Vec3,
        rates: Vec3,
    ) -> tuple[Vec3, Vec3]:
        """Specific force, m/s^2, and moment, ``moment_unit``, body.

        Args:
            params: of the vehicle.
            actuators: their state.
            actuator_rate: its derivative, 1/s.
            velocity: m/s, body.
            rates: rad/s, body.
        """
        raise NotImplementedError

    def angular_acceleration(
        self, c: Constants, moment: Vec3, rates: Vec3, command: Command
    ) -> Vec3:
        """The derivative of the body rates, rad/s^2: the moment, where it is per inertia."""
        return moment

    def angular_momentum(
        self, c: Constants, actuators: Actuators, rates: Vec3
    ) -> tuple[Vec3, Vec3]:
        """Angular momentum minus that of the rotors, and the gyroscopic moment; see ``balance``."""
        raise NotImplementedError

    def hover_actuators(self, c: Constants) -> Actuators:
        """The actuators' state in hover, within its range."""
        raise NotImplementedError

    def start_actuators(
        self, c: Constants, drawn: jax.Array, thrust: tuple[jax.Array, jax.Array]
    ) -> Actuators:
        """The actuators' state at a start: drawn over their range; see ``start``."""
        low, high = self.actuator_range(c)
        pairs = zip(jax.tree.leaves(low), jax.tree.leaves(high), strict=True)
        values = [between(*ends, drawn[index]) for index, ends in enumerate(pairs)]
        return jax.tree.unflatten(jax.tree.structure(low), values)

    def derivative(
        self, params: VehicleParams, state: RigidBodyState, command: Command
    ) -> RigidBodyState:
        """The time derivative of a state under a command, as a state."""
        c, actuators = params.constants, self.hold(state, command).actuators
        a = _once(params, attitude, state.euler)
        velocity = _once(params, world_to_body, a, state.velocity)
        rate = self.actuator_rate(c, actuators, command)
        force, moment = self.force_moment(params, actuators, rate, velocity, state.rates)
        disturbed = state.moment_ext is not None and state.force_ext is not None
        if disturbed:
            force, moment = force + state.force_ext, moment + state.moment_ext
        acceleration = body_to_world(a, force)
        return RigidBodyState(
            position=state.velocity,
            velocity=acceleration.replace(z=acceleration.z + c.g),
            euler=euler_rates(a, state.rates),
            rates=self.angular_acceleration(c, moment, state.rates, command),
            actuators=rate,
            moment_ext=Vec3.zero() if disturbed else None,
            force_ext=Vec3.zero() if disturbed else None,
        )

    def specific_force(self, params: VehicleParams, state: RigidBodyState) -> Vec3:
        """What an ideal accelerometer measures, m/s^2, body."""
        velocity = world_to_body(attitude(state.euler), state.velocity)
        steady = jax.tree.map(jnp.zeros_like, state.actuators)  # has no effect on forces
        force, _ = self.force_moment(params, state.actuators, steady, velocity, state.rates)
        return force if state.force_ext is None else force + state.force_ext

    def balance(self, params: VehicleParams, measured: Measurement) -> tuple[Vec3, Vec3, Vec3]:
        """The terms that the disturbance estimator compares; see ``VehicleModel.balance``."""
        actuators, rates = measured.rpm, measured.gyro
        momentum, gyroscopic = self.angular_momentum(params.constants, actuators, rates)
        # The moment of rotor acceleration is differentiated by the filter, not here.
        steady = jax.tree.map(jnp.zeros_like, actuators)
        force, moment = self.force_moment(params, actuators, steady, measured.body_velocity, rates)
        return momentum, gyroscopic - moment, measured.specific_force - force

    def start(
        self, c: Constants, motion: Motion, drawn: jax.Array, thrust: tuple[jax.Array, jax.Array]
    ) -> RigidBodyState:
        """The start of an episode, without external disturbances; see ``VehicleModel.start``."""
        return self._at(motion, self.start_actuators(c, drawn, thrust))

    def hover(self, c: Constants, motion: Motion) -> RigidBodyState:
        """As ``start``, with the actuators of a hover."""
        return self._at(motion, self.hover_actuators(c))

    def _at(self, motion: Motion, actuators: Actuators) -> RigidBodyState:
        euler = quaternion.of_euler(motion.euler) if self.quaternion else motion.euler
        external = (Vec3.zero(), Vec3.zero()) if self.disturbed else (None, None)
        return RigidBodyState(
            motion.position, motion.velocity, euler, motion.rates, actuators, *external
        )

    def position(self, state: RigidBodyState) -> Vec3:
        """Position, m, world."""
        return state.position

    def velocity(self, state: RigidBodyState) -> Vec3:
        """Velocity, m/s, world."""
        return state.velocity

    def euler(self, state: RigidBodyState) -> Vec3:
        """Roll, pitch and yaw, rad."""
        if isinstance(state.euler, Quaternion):
            return quaternion.to_euler(state.euler, arctan2)
        return state.euler

    def rates(self, state: RigidBodyState) -> Vec3:
        """Body rates p, q, r, rad/s."""
        return state.rates

    def actuator_state(self, state: RigidBodyState) -> Actuators:
        """The actuators' state."""
        return state.actuators

    def to_body(self, state: RigidBodyState, vector: Vec3) -> Vec3:
        """A world-frame vector in the body frame."""
        return world_to_body(attitude(state.euler), vector)

    def wrap(self, state: RigidBodyState) -> RigidBodyState:
        """The state with angles wrapped or the quaternion normalized, after each step."""
        euler = state.euler
        if isinstance(euler, Quaternion):
            return state.replace(euler=quaternion.normalized(euler))
        return state.replace(euler=euler.replace(x=wrap_angle(euler.x), z=wrap_angle(euler.z)))

    @property
    def pitch_limit(self) -> float:
        """The largest pitch at which the state is valid, rad; inf if any."""
        return math.inf if self.quaternion else super().pitch_limit

    def with_quaternions(self) -> Self:
        """The model whose attitude is a quaternion, so that any attitude is valid."""
        return dataclasses.replace(self, quaternion=True)

    def with_disturbances(self) -> Self:
        """The model whose state has an external moment and force."""
        return dataclasses.replace(self, disturbed=True)

    def disturbance(self, state: RigidBodyState) -> tuple[Vec3, Vec3]:
        """External moment, ``moment_unit``, and specific force, m/s^2, body."""
        assert state.moment_ext is not None and state.force_ext is not None
        return state.moment_ext, state.force_ext

    def with_disturbance(self, state: RigidBodyState, moment: Vec3, force: Vec3) -> RigidBodyState:
        """The state with an external moment and force, as of ``disturbance``."""
        return state.replace(moment_ext=moment, force_ext=force)


def _once(params: VehicleParams, function: Callable[..., Any], *arguments: Any) -> Any:
    """``function(*arguments)``, with its values computed once where ``opaque_true`` is given."""
    if params.opaque_true is None:
        return function(*arguments)
    return call_materialized_forward(function, params.opaque_true, *arguments)


def angular_acceleration(c: Constants, moment: Vec3, rates: Vec3) -> Vec3:
    """``I^-1 (M - Omega x I Omega)``, rad/s^2, body frame, of a moment, N m, and rates, rad/s."""
    p, q, r = rates.x, rates.y, rates.z
    return Vec3(
        (moment.x + (c.i_yy - c.i_zz) * q * r) / c.i_xx,
        (moment.y + (c.i_zz - c.i_xx) * r * p) / c.i_yy,
        (moment.z + (c.i_xx - c.i_yy) * p * q) / c.i_zz,
    )


def gyroscopic_moment(c: Constants, rates: Vec3) -> Vec3:
    """``Omega x I Omega``, N m, body frame, of rates, rad/s."""
    p, q, r = rates.x, rates.y, rates.z
    return Vec3((c.i_zz - c.i_yy) * q * r, (c.i_xx - c.i_zz) * r * p, (c.i_yy - c.i_xx) * p * q)
