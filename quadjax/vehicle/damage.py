"""A damaged or unbalanced drone: the motor-level model with weaker rotors and a shifted mass."""

import dataclasses
import functools
from collections.abc import Sequence

from quadjax.core.materialize import Caller, call_directly
from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle import motor
from quadjax.vehicle.motor import MotorState
from quadjax.vehicle.protocol import VehicleModel, VehicleParams

Factors = tuple[float, float, float, float]


@functools.cache
def damaged(rotors: Factors, imbalance: tuple[float, float] = (0.0, 0.0)) -> VehicleModel:
    """The motor-level model of a drone that is damaged or unbalanced.

    A rotor of thrust factor f has the forces and moments that one without damage has at
    ``sqrt(f)`` times its speed. The measured speeds are the true ones. A shift c of the center of
    mass adds the moment ``-c x m F`` of the specific force F. Equal arguments give the same object,
    so that nothing is compiled twice.

    Args:
        rotors: thrust factor of each of the four rotors, above 0.
        imbalance: mass times shift of the center of mass along body x and y, kg m.
    """
    slowed = tuple(float(factor) ** 0.5 for factor in rotors)
    return dataclasses.replace(
        motor.MODEL,
        derivative=functools.partial(_derivative, slowed, imbalance),
        specific_force=functools.partial(_specific_force, slowed),
    )


def _slowed(rpm: Rotors, slowed: Sequence[float]) -> Rotors:
    return Rotors(*(w * each for w, each in zip(rpm.components(), slowed, strict=True)))


def _specific_force(slowed: Sequence[float], params: VehicleParams, state: MotorState) -> Vec3:
    return motor.specific_force(params, state.replace(rpm=_slowed(state.rpm, slowed)))


def _derivative(
    slowed: Sequence[float],
    imbalance: Sequence[float],
    params: VehicleParams,
    state: MotorState,
    command: Rotors,
    call: Caller = call_directly,
) -> MotorState:
    own = state.replace(rpm=_slowed(state.rpm, slowed))
    (x, y), force = imbalance, motor.specific_force(params, own)
    moment = Vec3(-y * force.z, x * force.z, y * force.x - x * force.y)
    own = own.replace(moment_ext=state.moment_ext + moment)
    result = motor.derivative(params, own, _slowed(command, slowed), call)
    return result.replace(rpm=_slowed(result.rpm, [1.0 / each for each in slowed]))
