"""The vehicle model of an intervention: motors with their limits, and INDI's inner loop before them.

Commands are those of the model ``rate``, body rates and specific thrust, but it is the loop of
``quadjax.plant.indi_simple`` that follows them, in continuous time and without its filters, through
the motors of the model ``motor``. A policy that is trained on it meets the motors' limits as the
inner loop of the plant does; a policy that is trained on ``rate`` never does.
"""

import dataclasses

import jax
import jax.numpy as jnp

from quadjax.core.frames import attitude, body_to_world, euler_rates, world_to_body
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.indi import PITCH, ROLL, YAW, total
from quadjax.plant.indi_simple import MIX, UNITS, mixed
from quadjax.vehicle import motor, rate
from quadjax.vehicle.constants import constant
from quadjax.vehicle.motor import Motor, MotorConstants
from quadjax.vehicle.protocol import Signal, VehicleParams
from quadjax.vehicle.rigid_body import BodyState, RigidBodyState

GAIN, THRUST_GAIN, SAMPLE_RATE = 28.0, 500.0, 512.0  # 1/s, units per m/s^2, Hz
EFFECT = (0.06, 0.04, 0.003, 0.1219)  # rad/s^2 per unit, as in configs/plant/cyberzoo.yaml
OBSERVED_LAG = 0.03  # s, of the thrust that is measured


class Constants(MotorConstants):
    """Constants of the motors, and the limits of the commands."""

    p_max: jax.Array = constant("rad/s", "limits", "positive")
    q_max: jax.Array = constant("rad/s", "limits", "positive")
    r_max: jax.Array = constant("rad/s", "limits", "positive")
    thrust_min: jax.Array = constant("m/s^2", "limits")
    thrust_max: jax.Array = constant("m/s^2", "limits", above="thrust_min")


class LoopState(RigidBodyState):
    """State of a drone whose actuator, as a policy sees it, is the measured thrust."""

    rotors: Rotors | None = None  # rpm
    yaw_change: jax.Array | None = None  # () last change of the yaw command, units


class InnerLoop(Motor):
    """The model ``inner_loop``: four motors and the loop that follows rates and thrust."""

    name, constants = "inner_loop", Constants
    commands, actuators = rate.Rate.commands, Signal("thrust", 1, "m/s^2")
    has_battery = can_be_disturbed = False

    def command_range(self, c):
        """Lowest and highest command."""
        return rate.MODEL.command_range(c)

    def actuator_range(self, c):
        """Lowest and highest thrust, m/s^2."""
        return rate.MODEL.actuator_range(c)

    def start_actuators(self, c, numbers, thrust):
        """A thrust, drawn as that of the model ``rate``."""
        return rate.MODEL.start_actuators(c, numbers, thrust)

    def hover_actuators(self, c):
        """The thrust of a hover."""
        return rate.MODEL.hover_actuators(c)

    def start(self, c, motion, numbers, thrust):
        """The start of an episode, with four equal rotors."""
        return with_rotors(c, super().start(c, motion, numbers, thrust))

    def hover(self, c, motion):
        """A hover."""
        return with_rotors(c, super().hover(c, motion))

    def derivative(self, params: VehicleParams, state: LoopState, command) -> LoopState:
        """The time derivative of a state under a command."""
        c, rpm, a = params.constants, state.rotors, attitude(state.euler)
        velocity = world_to_body(a, state.velocity)
        force, moment = self.force_moment(params, BodyState.steady(velocity, state.rates, rpm))
        turning = motor.angular_acceleration(c, moment, state.rates)
        wanted = (command.rates - state.rates) * GAIN - turning
        sent = commands(c, state, wanted, (command.thrust + force.z) * THRUST_GAIN)
        speeding = (sent - rpm) / c.tau
        yaw = turning.z + total(YAW, speeding) * c.k_r2 / c.i_zz
        acceleration = body_to_world(a, force)
        return LoopState(
            position=state.velocity,
            velocity=acceleration.replace(z=acceleration.z + c.g),
            euler=euler_rates(a, state.rates),
            rates=turning.replace(z=yaw),
            actuators=(-force.z - state.actuators) / OBSERVED_LAG,
            rotors=speeding,
            yaw_change=(wanted.z - EFFECT[2] * state.yaw_change) * SAMPLE_RATE / EFFECT[3],
        )


def with_rotors(c: Constants, state: RigidBodyState) -> LoopState:
    """A state whose rotors are equal and give its thrust."""
    fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    rotors = Rotors.same(jnp.clip(jnp.sqrt(state.actuators / (4.0 * c.k_w)), c.rpm_min, c.rpm_max))
    return LoopState(**fields, rotors=rotors, yaw_change=jnp.zeros_like(state.actuators))


def commands(c: Constants, state: LoopState, wanted: Vec3, lift: jax.Array) -> Rotors:
    """Rpm commands of the loop, of missing angular acceleration, rad/s^2, and thrust, units."""
    unit = (c.rpm_max - c.rpm_min) / UNITS
    now = (state.rotors + -c.rpm_min) * (1.0 / unit)
    signs = ROLL, PITCH, YAW
    turn = [total(s, now) * (0.25 / factor) for s, factor in zip(signs, MIX, strict=True)]
    change = wanted.x / EFFECT[0], wanted.y / EFFECT[1], state.yaw_change
    turn = [jnp.clip(u + du, -UNITS, UNITS) for u, du in zip(turn, change, strict=True)]
    thrust = jnp.clip(0.25 * total((1.0,) * 4, now) + lift, 0.0, UNITS)
    return mixed(c, Rotors(*turn, thrust))


MODEL = InnerLoop()
