"""Inner loop from body rates and specific thrust to rpm: incremental dynamic inversion (INDI).

Smeur, Chu and de Croon, "Adaptive incremental nonlinear dynamic inversion for attitude control of
micro air vehicles", Journal of Guidance, Control, and Dynamics 39(3), 2016. The present
acceleration is the one modeled from the rotor speeds plus the filtered difference of measurement
and model; the same filter ``H`` on both gives them the same delay::

    alpha = G(omega) + H[ Omega' - G(omega) - G2 omega' ]        (+ G2 omega')
    T     = T(omega) + H[ -f_z - T(omega) ]

``G`` is the angular acceleration due to rotor speeds, ``G2`` that due to their derivatives, which
dominates yaw; ``f_z`` is the accelerometer. Differentiation is part of the filter, as in
``quadjax.vehicle.estimator``.

The motors are first-order lags, ``omega' = (u - omega) / tau``, so an rpm command sets a rotor
acceleration. With ``nu = gain (Omega_c - Omega)`` it is chosen such that roll, pitch and thrust
follow with given lags, shorter than the motors', and yaw without one::

    G omega'  = (nu - alpha) / moment_lag       T' = (T_c - T) / thrust_lag
    G2 omega' = nu - alpha                      in yaw

The four rows are solved at the present speeds. In ``x = omega omega'`` the signs of roll, pitch,
yaw and thrust are orthogonal, so the solution is explicit. When a motor saturates, roll and pitch
have priority over thrust, and thrust over yaw.
"""

import functools
import operator

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.filters import LowPass, advance, butterworth, settled
from quadjax.core.traced import as_leaves
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.config import IndiConfig
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import Measurement
from quadjax.vehicle.rate import RateCommand

LEAST_RPM = 2000.0  # below it the effectiveness is constant
Signs = tuple[float, float, float, float]  # of the rotors
ROLL: Signs = (1.0, -1.0, -1.0, 1.0)
PITCH: Signs = (1.0, 1.0, -1.0, -1.0)
YAW: Signs = (-1.0, 1.0, -1.0, 1.0)


class IndiParams(struct.PyTreeNode):
    """Numbers of the inner loop, all traced."""

    constants: MotorConstants  # of the onboard model
    filter: LowPass
    gains: IndiConfig


class IndiState(struct.PyTreeNode):
    """Two memories for each of the filter's four channels, and the last thrust estimate."""

    memory_1: Vec3
    memory_2: Vec3
    thrust_1: jax.Array
    thrust_2: jax.Array
    thrust: jax.Array  # () estimated specific thrust, m/s^2


def indi_params(constants: MotorConstants, config: IndiConfig, sample_rate: float) -> IndiParams:
    """The inner loop with an onboard model of ``constants``, at a sample rate in Hz."""
    numbers = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), constants)
    return IndiParams(numbers, butterworth(sample_rate, config.cutoff), as_leaves(config))


def total(signs: Signs, values: Rotors) -> jax.Array:
    """Sum () over the rotors of signs times values."""
    parts = zip(signs, values.components(), strict=True)
    return functools.reduce(operator.add, (sign * value for sign, value in parts))


def modeled(c: MotorConstants, rpm: Rotors) -> tuple[Vec3, jax.Array]:
    """Angular acceleration, rad/s^2, and specific thrust (), m/s^2, due to rotor speeds."""
    square = rpm * rpm
    turning = Vec3(
        total(ROLL, square) * (c.k_p / c.i_xx),
        total(PITCH, square) * (c.k_q / c.i_yy),
        total(YAW, rpm) * (c.k_r1 / c.i_zz),
    )
    return turning, c.k_w * (square.w1 + square.w2 + square.w3 + square.w4)


def _differentiated(c: MotorConstants, measurement: Measurement) -> Vec3:
    """Body rates less the yaw rate due to changes of rotor speed, rad/s."""
    return measurement.gyro.replace(
        z=measurement.gyro.z - total(YAW, measurement.actuators) * (c.k_r2 / c.i_zz)
    )


def init(params: IndiParams, measurement: Measurement) -> IndiState:
    """The filter before the first sample, with no difference of measurement and model."""
    steady = _differentiated(params.constants, measurement)
    _, thrust = modeled(params.constants, measurement.actuators)
    zero = jnp.zeros_like(measurement.specific_force.z)
    return IndiState(*settled(steady, params.filter.derivative), zero, zero, thrust)


def update(
    params: IndiParams, state: IndiState, measurement: Measurement, command: RateCommand
) -> tuple[IndiState, Rotors]:
    """One sample of the inner loop of one drone.

    Args:
        params: of the loop.
        state: from ``init`` or the last ``update``.
        measurement: of this sample; its body velocity is not used.
        command: wanted body rates, rad/s, and specific thrust, m/s^2.

    Returns:
        The new state and the rpm commands, clipped to the range of the motors.
    """
    c, gains, low_pass = params.constants, params.gains, params.filter
    a, b, b_d = low_pass.feedback, low_pass.forward, low_pass.derivative
    turning, lift = modeled(c, measurement.actuators)
    rates = _differentiated(c, measurement)
    rest, memory = advance(a, [(rates, b_d), (turning * -1.0, b)], (state.memory_1, state.memory_2))
    rest_thrust, thrust = advance(
        a, [(-measurement.specific_force.z - lift, b)], (state.thrust_1, state.thrust_2)
    )
    next_state = IndiState(*memory, *thrust, lift + rest_thrust)
    rate_gain = Vec3(*map(jnp.asarray, (gains.roll_gain, gains.pitch_gain, gains.yaw_gain)))
    wanted = (command.rates - measurement.gyro) * rate_gain - (turning + rest)
    rise = (command.thrust - next_state.thrust) / gains.thrust_lag
    return next_state, allocate(params, measurement.actuators, wanted, rise)


def allocate(params: IndiParams, rpm: Rotors, wanted: Vec3, rise: jax.Array) -> Rotors:
    """Rpm commands for a change of the accelerations, within the motors' limits.

    Args:
        params: of the loop.
        rpm: propeller speeds, rpm.
        wanted: change of the angular acceleration, rad/s^2.
        rise: () derivative of the specific thrust, m/s^3.
    """
    c, lag = params.constants, params.gains.moment_lag
    speed = jax.tree.map(lambda w: jnp.maximum(w, LEAST_RPM), rpm)
    low = (rpm * -1.0 + c.rpm_min) * speed / c.tau
    high = (rpm * -1.0 + c.rpm_max) * speed / c.tau
    roll = wanted.x * c.i_xx / (8.0 * c.k_p * lag)
    pitch = wanted.y * c.i_yy / (8.0 * c.k_q * lag)
    turn = Rotors(*(a * roll + b * pitch for a, b in zip(ROLL, PITCH, strict=True)))
    turn = turn * turn_scale(turn, low, high)
    lift = jnp.clip(rise / (8.0 * c.k_w), highest(low - turn), -highest(turn - high))
    base = turn + lift
    slowness = jax.tree.map(lambda w: 1.0 / w, speed)
    coupled = total(YAW, base * slowness)
    yaw = (wanted.z * (c.i_zz / c.k_r2) - coupled) / sum(slowness.components())
    added = Rotors(*(sign * yaw for sign in YAW))
    x = base + added * added_scale(base, added, low, high)
    commands = rpm + x * slowness * c.tau
    return jax.tree.map(lambda u: jnp.clip(u, c.rpm_min, c.rpm_max), commands)


def highest(values: Rotors) -> jax.Array:
    """The highest () of four numbers."""
    return functools.reduce(jnp.maximum, values.components())


def turn_scale(turn: Rotors, low: Rotors, high: Rotors) -> jax.Array:
    """Largest factor () on a turn that fits within the limits for some thrust."""
    fraction = jnp.ones_like(turn.w1)
    for i in range(4):
        for j in range(4):
            apart = turn[j] - turn[i]
            room = jnp.maximum(high[j] - low[i], 0.0)
            fits = room / jnp.where(apart > room, apart, 1.0)
            fraction = jnp.where(apart > room, jnp.minimum(fraction, fits), fraction)
    return fraction


def added_scale(base: Rotors, added: Rotors, low: Rotors, high: Rotors) -> jax.Array:
    """Largest factor () on ``added`` such that ``base`` plus it fits within the limits."""
    fraction = jnp.ones_like(base.w1)
    for b, d, bottom, top in zip(
        base.components(), added.components(), low.components(), high.components(), strict=True
    ):
        # Rounding may leave ``base`` just beyond a limit.
        room = jnp.maximum(jnp.where(d > 0.0, top - b, b - bottom), 0.0)
        size = jnp.abs(d)
        tight = size > room
        fraction = jnp.where(
            tight, jnp.minimum(fraction, room / jnp.where(tight, size, 1.0)), fraction
        )
    return fraction
