"""The vehicle model of an intervention: motors with their limits, and INDI's inner loop on them.

Commands are those of the model ``rate``, body rates and specific thrust, but it is the loop of
``quadjax.plant.indi_simple`` that follows them, in continuous time and without its filters, through
the motors of the model ``motor``. A policy that is trained on it meets the motors' limits as on the
plant; one that is trained on ``rate`` never does.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from quadjax.core.frames import attitude, body_to_world, euler_rates, world_to_body
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.indi import PITCH, ROLL, YAW, total
from quadjax.plant.indi_simple import COMMAND_UNITS, MIX, mixed
from quadjax.vehicle import motor, rate
from quadjax.vehicle.constants import constant
from quadjax.vehicle.motor import Motor, MotorConstants
from quadjax.vehicle.protocol import Signal, VehicleParams
from quadjax.vehicle.rate import RateCommand
from quadjax.vehicle.rigid_body import BodyState, RigidBodyState

GAIN, THRUST_GAIN, SAMPLE_RATE = 28.0, 500.0, 512.0  # 1/s, units per m/s^2, Hz
EFFECT = (0.06, 0.04, 0.003, 0.1219)  # rad/s^2 per unit, as in configs/plant/cyberzoo.yaml
OBSERVED_LAG = 0.03  # s, of the measured thrust


class Constants(MotorConstants):
    """Constants of the motors, and the limits of the commands."""

    p_max: jax.Array = constant("rad/s", "limits", "positive")
    q_max: jax.Array = constant("rad/s", "limits", "positive")
    r_max: jax.Array = constant("rad/s", "limits", "positive")
    thrust_min: jax.Array = constant("m/s^2", "limits")
    thrust_max: jax.Array = constant("m/s^2", "limits", above="thrust_min")


class LoopState(RigidBodyState):
    """State of a drone whose actuator, as a policy sees it, is the measured thrust, m/s^2."""

    rotors: Any = None  # rpm
    yaw_change: Any = None  # () last change of the yaw command, units


class InnerLoop(Motor):
    """The model ``inner_loop``: four motors and the loop that follows rates and thrust."""

    name, constants = "inner_loop", Constants
    commands, actuators = rate.Rate.commands, Signal("thrust", 1, "m/s^2")
    has_battery = can_be_disturbed = False
    command_range, actuator_range = rate.Rate.command_range, rate.Rate.actuator_range
    start_actuators, hover_actuators = rate.Rate.start_actuators, rate.Rate.hover_actuators

    def start(self, c: Constants, *numbers: Any) -> LoopState:
        """The start of an episode, with equal rotors."""
        return with_rotors(c, super().start(c, *numbers))

    def hover(self, c: Constants, *numbers: Any) -> LoopState:
        """A hover."""
        return with_rotors(c, super().hover(c, *numbers))

    def derivative(
        self, params: VehicleParams, state: LoopState, command: RateCommand
    ) -> LoopState:
        """The time derivative of a state under a command."""
        c, rpm, a = params.constants, state.rotors, attitude(state.euler)
        velocity = world_to_body(a, state.velocity)
        force, moment = self.force_moment(params, BodyState.steady(velocity, state.rates, rpm))
        turning = motor.angular_acceleration(c, moment, state.rates)
        wanted = (command.rates - state.rates) * GAIN - turning
        sent = rpm_commands(c, state, wanted, (command.thrust + force.z) * THRUST_GAIN)
        speeding = (sent - rpm) / c.tau
        acceleration = body_to_world(a, force)
        return LoopState(
            position=state.velocity,
            velocity=acceleration.replace(z=acceleration.z + c.g),
            attitude=euler_rates(a, state.rates),
            rates=turning.replace(z=turning.z + total(YAW, speeding) * c.k_r2 / c.i_zz),
            actuators=(-force.z - state.actuators) / OBSERVED_LAG,
            rotors=speeding,
            yaw_change=(wanted.z - EFFECT[2] * state.yaw_change) * SAMPLE_RATE / EFFECT[3],
        )


def with_rotors(c: Constants, state: RigidBodyState) -> LoopState:
    """A state whose rotors are equal and give its thrust."""
    fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    rpm = jnp.clip(jnp.sqrt(state.actuators / (4.0 * c.k_w)), c.rpm_min, c.rpm_max)
    return LoopState(**fields, rotors=Rotors.same(rpm), yaw_change=jnp.zeros_like(rpm))


def rpm_commands(c: Constants, state: LoopState, wanted: Vec3, lift: jax.Array) -> Rotors:
    """Commands to the motors of missing angular acceleration, rad/s^2, and thrust, units."""
    unit = (c.rpm_max - c.rpm_min) / COMMAND_UNITS
    now = (state.rotors + -c.rpm_min) * (1.0 / unit)
    each = zip((ROLL, PITCH, YAW), MIX, strict=True)
    turn = [total(signs, now) * (0.25 / factor) for signs, factor in each]
    change = wanted.x / EFFECT[0], wanted.y / EFFECT[1], state.yaw_change
    turn = [
        jnp.clip(u + du, -COMMAND_UNITS, COMMAND_UNITS) for u, du in zip(turn, change, strict=True)
    ]
    thrust = jnp.clip(0.25 * total((1.0,) * 4, now) + lift, 0.0, COMMAND_UNITS)
    return mixed(c, Rotors(*turn, thrust))


MODEL = InnerLoop()
