"""A rigid body with four rotors and a quaternion attitude, common to the racing models.

A model adds its constants and one function ``forces``. World NED, body FRD; forces and moments are
specific (m/s^2, rad/s^2). Rotors: 1 front-left, 2 front-right, 3 rear-right, 4 rear-left.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax
from flax import struct

from quadjax.core.frames import attitude, body_to_world, euler_rates, world_to_body
from quadjax.core.materialize import Caller, call_directly
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors, Vec3, between
from quadjax.vehicle.attitude import with_quaternions
from quadjax.vehicle.protocol import (
    Constants,
    Motion,
    Signal,
    VehicleModel,
    VehicleParams,
)

# (constants, rotors, command, body velocity, body rates) ->
# (specific force, m/s^2, angular acceleration, rad/s^2, rotors' derivative), body frame
Forces = Callable[[Constants, Rotors, Rotors, Vec3, Vec3], tuple[Vec3, Vec3, Rotors]]


@struct.dataclass
class RigidBodyState:
    """State of one drone."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    euler: Vec3 | Quaternion  # attitude, body to world
    rates: Vec3  # p, q, r, rad/s, body
    rotors: Rotors  # speeds, rad/s, or thrusts, N


def per_rotor(constants: Constants, name: str) -> Rotors:
    """The constants ``name1`` to ``name4``."""
    return Rotors(*(getattr(constants, f"{name}{index}") for index in (1, 2, 3, 4)))


def derivative(
    forces: Forces,
    params: VehicleParams,
    state: RigidBodyState,
    command: Rotors,
    call: Caller = call_directly,
) -> RigidBodyState:
    """Time derivative of the state under a command, as a ``RigidBodyState``.

    ``call`` calls a function and materializes its values.
    """
    c = params.constants
    a = call(attitude, state.euler)
    velocity = call(world_to_body, a, state.velocity)
    force, spin, rotors = forces(c, state.rotors, command, velocity, state.rates)
    acceleration = body_to_world(a, force)
    return RigidBodyState(
        position=state.velocity,
        velocity=acceleration.replace(z=acceleration.z + c.g),
        euler=euler_rates(a, state.rates),
        rates=spin,
        rotors=rotors,
    )


def _specific_force(forces: Forces, params: VehicleParams, state: RigidBodyState) -> Vec3:
    velocity = world_to_body(attitude(state.euler), state.velocity)
    return forces(params.constants, state.rotors, state.rotors, velocity, state.rates)[0]


def rigid_body_model(
    name: str,
    constants: type,
    command: Signal,
    rotors: Signal,
    forces: Forces,
    rotor_range: Callable[[Constants], tuple[Rotors, Rotors]],
    hover: Callable[[Constants], Rotors],
    **others: Any,
) -> VehicleModel:
    """The vehicle model of a rigid body with four rotors.

    Args:
        name: of the model.
        constants: dataclass of scalars, with ``g``.
        command: of the rotors, name, size and unit.
        rotors: their state, name, size and unit.
        forces: the equations; see ``Forces``.
        rotor_range: lowest and highest state of the rotors.
        hover: the rotors' state in hover.
        others: further fields of ``VehicleModel``; ``command_range`` among them.
    """

    def start(
        c: Constants, motion: Motion, drawn: jax.Array, _: tuple[jax.Array, jax.Array]
    ) -> RigidBodyState:
        pairs = zip(*rotor_range(c), strict=True)
        rotors = (between(low, high, drawn[i]) for i, (low, high) in enumerate(pairs))
        return RigidBodyState(**vars(motion), rotors=Rotors(*rotors))

    with_euler_angles = VehicleModel(
        name=name,
        constants=constants,
        commands=(command,),
        actuators=rotors,
        derivative=functools.partial(derivative, forces),
        actuator_range=rotor_range,
        actuator_state=lambda state: state.rotors,
        start=start,
        hover=lambda c, motion: RigidBodyState(**vars(motion), rotors=hover(c)),
        specific_force=functools.partial(_specific_force, forces),
        **others,
    )
    return with_quaternions(with_euler_angles)
