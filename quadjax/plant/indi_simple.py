"""Paparazzi's inner loop ``stabilization_indi_simple``, which flew the INDI policy.

The loop of Ferede et al. (arXiv 2311.16948) at tudelft/paparazzi 6189594, written from its
equations (Smeur, Chu and de Croon, Journal of Guidance, Control, and Dynamics 39(3), 2016). It
does not use propeller speeds: commands ``u`` of roll, pitch, yaw and thrust go through a
first-order model of the actuators and through the low-pass ``H`` of the measured rates and specific
force::

    du_roll  = (gain (p_c - p) - H[p]') / g1            the same for pitch
    du_yaw   = (gain (r_c - r) - H[r]' + g2 du_yaw of the sample before) / (g1 + g2)
    du_T     = thrust_gain (T_c - H[-f_z])
    u        = H[actuators(u)] + du

All commands are in units of the autopilot: 9600 of them are the range of the motors. Its mixer adds
them to the command of each motor; when one saturates, roll and pitch have priority over thrust, and
thrust over yaw, or with ``saturation: clip`` each motor is limited by itself.
"""

from typing import Any, Literal

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.filters import LowPass, Sample, advance, butterworth
from quadjax.core.traced import as_leaves
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.config import IndiSimpleConfig
from quadjax.plant.indi import PITCH, ROLL, YAW, added_scale, highest, total, turn_scale
from quadjax.vehicle.motor import MotorConstants, hover_rpm
from quadjax.vehicle.protocol import Measurement
from quadjax.vehicle.rate import RateCommand

COMMAND_UNITS = 9600.0  # of the autopilot
MIX = (181.0 / 256.0, 181.0 / 256.0, 128.0 / 256.0)  # of roll, pitch and yaw in a motor's command


class SimpleParams(struct.PyTreeNode):
    """Numbers of the inner loop, all traced."""

    filter: LowPass
    numbers: IndiSimpleConfig  # with effectiveness and thrust gain
    actuators: jax.Array  # () of a change, in one sample
    sample_rate: jax.Array  # () Hz
    rpm_min: jax.Array  # () rpm, of the motors
    rpm_max: jax.Array


class SimpleState(struct.PyTreeNode):
    """Commands, and the memories of the filters."""

    command: Rotors  # of roll, pitch, yaw, thrust in the last sample
    actuators: Rotors  # the same through the model of the actuators
    actuators_1: Rotors
    actuators_2: Rotors
    rates: Vec3  # filtered, rad/s
    rates_1: Vec3
    rates_2: Vec3
    thrust: jax.Array  # () filtered specific thrust, m/s^2
    thrust_1: jax.Array
    thrust_2: jax.Array
    yaw_change: jax.Array  # () du_yaw of the last sample


def nominal_effectiveness(
    c: MotorConstants, rpm_max: float, sample_rate: float
) -> tuple[tuple[float, float, float, float], float]:
    """Effectiveness of the commands on the model in hover, and the inverse of that of thrust.

    Returns:
        Angular acceleration, rad/s^2, per unit of roll, pitch and yaw, and of a change of the yaw
        command in a sample; units of thrust per m/s^2.
    """
    unit, hover = (rpm_max - float(c.rpm_min)) / COMMAND_UNITS, float(hover_rpm(c))  # rpm
    roll, pitch, yaw = (4.0 * unit * factor for factor in MIX)
    turn = (
        2.0 * float(c.k_p) * hover * roll / float(c.i_xx),
        2.0 * float(c.k_q) * hover * pitch / float(c.i_yy),
        float(c.k_r1) * yaw / float(c.i_zz),
        float(c.k_r2) * yaw * sample_rate / float(c.i_zz),
    )
    return turn, 1.0 / (8.0 * float(c.k_w) * hover * unit)


def simple_params(
    c: MotorConstants, config: IndiSimpleConfig, rpm_max: float, sample_rate: float
) -> SimpleParams:
    """The inner loop of a drone whose motors take up to ``rpm_max``, at a sample rate in Hz."""
    return SimpleParams(
        filter=butterworth(sample_rate, config.cutoff),
        numbers=as_leaves(config),
        actuators=jnp.float32(1.0 - jnp.exp(-1.0 / (config.actuator_lag * sample_rate))),
        sample_rate=jnp.float32(sample_rate),
        rpm_min=jnp.float32(c.rpm_min),
        rpm_max=jnp.float32(rpm_max),
    )


def _settled(low_pass: LowPass, signal: Sample) -> tuple[Sample, Sample]:
    """The memories at which a constant signal has passed the low-pass."""
    a, b = low_pass.feedback, low_pass.forward
    second = jax.tree.map(lambda x: x * (b[2] - a[1]), signal)
    return jax.tree.map(lambda x: x * (1.0 - b[0]), signal), second


def init(params: SimpleParams, measurement: Measurement) -> SimpleState:
    """The loop before the first sample: commands, rates and thrust are steady."""
    unit = (params.rpm_max - params.rpm_min) / COMMAND_UNITS
    motors = (measurement.actuators + -params.rpm_min) * (1.0 / unit)
    roll, pitch, yaw = (
        total(signs, motors) * (0.25 / factor)
        for signs, factor in zip((ROLL, PITCH, YAW), MIX, strict=True)
    )
    command = Rotors(roll, pitch, yaw, 0.25 * total((1.0, 1.0, 1.0, 1.0), motors))
    rates, thrust = measurement.gyro, -measurement.specific_force.z
    low_pass = params.filter
    return SimpleState(
        command,
        *(command, *_settled(low_pass, command)),
        *(rates, *_settled(low_pass, rates)),
        *(thrust, *_settled(low_pass, thrust)),
        yaw_change=jnp.zeros_like(thrust),
    )


def update(
    params: SimpleParams, state: SimpleState, measurement: Measurement, command: RateCommand
) -> tuple[SimpleState, Rotors]:
    """One sample of the inner loop of one drone.

    Args:
        params: of the loop.
        state: from ``init`` or the last ``update``.
        measurement: of this sample; its propeller speeds and body velocity are not used.
        command: wanted body rates, rad/s, and specific thrust, m/s^2.

    Returns:
        The new state and the rpm commands, within the range of the motors.
    """
    a, b, n = params.filter.feedback, params.filter.forward, params.numbers
    actuators = state.actuators + (state.command - state.actuators) * params.actuators
    now, actuators_12 = advance(a, [(actuators, b)], (state.actuators_1, state.actuators_2))
    rates, rates_12 = advance(a, [(measurement.gyro, b)], (state.rates_1, state.rates_2))
    measured = -measurement.specific_force.z
    thrust, thrust_12 = advance(a, [(measured, b)], (state.thrust_1, state.thrust_2))
    yaw_rate = jnp.clip(command.rates.z, -n.yaw_rate, n.yaw_rate)
    error = command.rates.replace(z=yaw_rate) - measurement.gyro
    wanted = error * n.gain - (rates - state.rates) * params.sample_rate
    assert n.effectiveness is not None and n.thrust_gain is not None
    roll, pitch, yaw, yaw_change = n.effectiveness
    du_yaw = (wanted.z + yaw_change * state.yaw_change) / (yaw + yaw_change)
    change = Rotors(
        wanted.x / roll, wanted.y / pitch, du_yaw, (command.thrust - thrust) * n.thrust_gain
    )
    turn = jax.tree.map(lambda u: jnp.clip(u, -COMMAND_UNITS, COMMAND_UNITS), now + change)
    limited = turn.replace(w4=jnp.maximum(turn.w4, 0.0))
    parts = (actuators, *actuators_12, rates, *rates_12, thrust, *thrust_12)
    state = SimpleState(limited, *parts, du_yaw)
    return state, mixed(params, limited, params.numbers.saturation)


def mixed(params: Any, command: Rotors, saturation: Literal["clip"] | None = None) -> Rotors:
    """Rpm commands of commands of roll, pitch, yaw and thrust, within the range of the motors.

    Args:
        params: numbers with ``rpm_min`` and ``rpm_max``.
        command: in units of the autopilot.
        saturation: as in the config.
    """
    roll, pitch, yaw = (u * f for u, f in zip(command.components(), MIX, strict=False))
    low, high = Rotors.same(jnp.zeros_like(roll)), Rotors.same(jnp.full_like(roll, COMMAND_UNITS))
    turn = Rotors(*(a * roll + b * pitch for a, b in zip(ROLL, PITCH, strict=True)))
    added = Rotors(*(sign * yaw for sign in YAW))
    if saturation == "clip":
        motors = turn + command.w4 + added
    else:
        turn = turn * turn_scale(turn, low, high)
        base = turn + jnp.clip(command.w4, highest(turn * -1.0), COMMAND_UNITS - highest(turn))
        motors = base + added * added_scale(base, added, low, high)
    unit = (params.rpm_max - params.rpm_min) / COMMAND_UNITS
    return jax.tree.map(
        lambda u: jnp.clip(params.rpm_min + u * unit, params.rpm_min, params.rpm_max), motors
    )
