"""Onboard estimate of the external moment and force: what is measured less what is modelled.

Every signal goes through the same causal second-order Butterworth low-pass ``H`` (Ferede et al.,
arXiv 2311.16948: 8 Hz), so that all of them share its delay and only their difference is left::

    M_ext = H [ (I Omega)' + Omega x I Omega - M(rpm, rpm', v, Omega) ]
    F_ext = H [ accelerometer - F(rpm, v) ]

``M`` and ``F`` include the residual networks where the vehicle has them. ``H`` is linear, so the
difference is formed first and filtered once: six filtered channels, not two dozen.

Two things are differentiated, the angular momentum and, for the yaw moment of rotor acceleration,
the propeller speeds. Differentiation is part of the filter: the bilinear transform of ``s H(s)``
has the poles of ``H``, a phase of exactly 90 degrees more at every frequency (so no delay of its
own, unlike a difference of two samples) and rolls off above the cut-off, so noise is not amplified.

With ``w = tan(pi f_c / f_s)``, ``n = 1 / (1 + sqrt(2) w + w^2)`` and ``k = n w^2``, computed as
``(a[0] + a[1] + a[2]) / 4`` so that rounding ``a`` leaves no bias::

    a   = [1, 2 n (w^2 - 1), n (1 - sqrt(2) w + w^2)]      both
    b   = k [1, 2, 1]                                      low-pass
    b_d = 2 f_s k [1, 0, -1]                               low-pass of the derivative

and each channel, with ``x`` what is filtered and ``x_d`` what is differentiated and filtered, runs
the transposed direct form II, two numbers of memory::

    y  =        b[0] x + b_d[0] x_d + s1
    s1 = s2 +   b[1] x + b_d[1] x_d - a[1] y
    s2 =        b[2] x + b_d[2] x_d - a[2] y

A simulation in explicit Euler steps is no sampled continuous flight: there the derivative at one
sample is the difference to the *next* one, half a sample later than the bilinear transform takes
it. ``explicit_euler`` uses ``b_m = k [0, 2, 2]`` for the moment's ``x``, which is the same half
sample later: then the estimate there is exactly that filter of the true external moment.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle.motor import MotorParams, force_moment

Scalar = jax.Array | float
SQRT2 = float(np.sqrt(2.0))
DEFAULT_CUTOFF = 8.0  # Hz


@struct.dataclass
class EstimatorParams:
    """The model that is subtracted and the coefficients of the filter; all of it traced."""

    vehicle: MotorParams
    feedback: jax.Array  # (2,) a[1], a[2]
    low_pass: jax.Array  # (3,) b, for the force
    low_pass_moment: jax.Array  # (3,) b, or k [0, 2, 2] in an explicit Euler simulation
    derivative: jax.Array  # (3,) b_d, 1/s


@struct.dataclass
class Measurement:
    """What is known on board at one sample."""

    gyro: Vec3  # p, q, r, rad/s, body
    specific_force: Vec3  # accelerometer less its bias, m/s^2, body
    rpm: Rotors  # propeller speeds, rpm
    body_velocity: Vec3  # m/s, body


@struct.dataclass
class EstimatorState:
    """Two numbers of memory for each of the six channels."""

    moment_1: Vec3  # N m
    moment_2: Vec3  # N m
    force_1: Vec3  # m/s^2
    force_2: Vec3  # m/s^2


def estimator_params(
    vehicle: MotorParams,
    sample_rate: Scalar,
    cutoff: Scalar = DEFAULT_CUTOFF,
    explicit_euler: bool = False,
) -> EstimatorParams:
    """The estimator of one vehicle at a fixed sample rate.

    Args:
        vehicle: constants, and residual if any, of the model that is subtracted.
        sample_rate: Hz, constant; may be traced.
        cutoff: -3 dB frequency of the low-pass, Hz; may be traced.
        explicit_euler: the samples are the steps of an explicit Euler simulation.

    Raises:
        InputError: a cut-off that is not between zero and half the sample rate (where both are
            plain numbers).
    """
    plain = isinstance(sample_rate, (int, float)) and isinstance(cutoff, (int, float))
    if plain and not 0.0 < cutoff < 0.5 * sample_rate:
        raise InputError(
            f"estimator cut-off {cutoff} Hz is not between 0 and half the sample rate "
            f"({sample_rate} Hz)"
        )
    library = np if plain else jnp  # in double precision where the numbers are known now
    w = library.tan(np.pi * cutoff / sample_rate)
    n = 1.0 / (1.0 + SQRT2 * w + w * w)
    feedback = jnp.stack(
        [jnp.asarray(a) for a in (2.0 * n * (w * w - 1.0), n * (1.0 - SQRT2 * w + w * w))]
    )
    k = 0.25 * ((1.0 + feedback[0]) + feedback[1])
    zero = jnp.zeros_like(k)
    low_pass = jnp.stack([k, 2.0 * k, k])
    return EstimatorParams(
        vehicle=vehicle,
        feedback=feedback,
        low_pass=low_pass,
        low_pass_moment=jnp.stack([zero, 2.0 * k, 2.0 * k]) if explicit_euler else low_pass,
        derivative=2.0 * sample_rate * jnp.stack([k, zero, -k]),
    )


def init(params: EstimatorParams, measurement: Measurement) -> EstimatorState:
    """The state before the first sample: no disturbance, rates and propellers steady until now.

    Starting from the first measurement keeps a drone that is already turning from looking like
    one that has just been struck. Pass the same measurement to the first ``update``.
    """
    momentum = _differentiated(params.vehicle, measurement)
    # The fixed point of the recursion at y = 0; b_d sums to zero.
    moment_2 = momentum * params.derivative[2]
    return EstimatorState(
        moment_1=momentum * params.derivative[1] + moment_2,
        moment_2=moment_2,
        force_1=jax.tree.map(jnp.zeros_like, measurement.specific_force),
        force_2=jax.tree.map(jnp.zeros_like, measurement.specific_force),
    )


def update(
    params: EstimatorParams, state: EstimatorState, measurement: Measurement
) -> tuple[EstimatorState, Vec3, Vec3]:
    """One sample of the estimator, of one drone.

    Args:
        params: see ``estimator_params``.
        state: from ``init`` or the last ``update``.
        measurement: this sample's.

    Returns:
        The new state, the external moment, N m, and the external specific force, m/s^2, both in
        the body frame and both as late as the filter is (about ``sqrt(2) / (2 pi f_c)``: 28 ms
        at 8 Hz).
    """
    momentum = _differentiated(params.vehicle, measurement)
    moment, force = _unexplained(params.vehicle, measurement)
    a, b, b_m, b_d = params.feedback, params.low_pass, params.low_pass_moment, params.derivative
    moment_ext = moment * b_m[0] + momentum * b_d[0] + state.moment_1
    force_ext = force * b[0] + state.force_1
    new_state = EstimatorState(
        moment_1=state.moment_2 + moment * b_m[1] + momentum * b_d[1] - moment_ext * a[0],
        moment_2=moment * b_m[2] + momentum * b_d[2] - moment_ext * a[1],
        force_1=state.force_2 + force * b[1] - force_ext * a[0],
        force_2=force * b[2] - force_ext * a[1],
    )
    return new_state, moment_ext, force_ext


def _differentiated(vehicle: MotorParams, measurement: Measurement) -> Vec3:
    """Angular momentum, N m s, less that which rotor acceleration turns into yaw moment."""
    c, rpm, rates = vehicle.constants, measurement.rpm, measurement.gyro
    rotors = c.k_r2 * (-rpm.w1 + rpm.w2 - rpm.w3 + rpm.w4)
    return Vec3(c.i_xx * rates.x, c.i_yy * rates.y, c.i_zz * rates.z - rotors)


def _unexplained(vehicle: MotorParams, measurement: Measurement) -> tuple[Vec3, Vec3]:
    """Gyroscopic less model moment, N m, and measured less model specific force, m/s^2."""
    c, rates = vehicle.constants, measurement.gyro
    p, q, r = rates.x, rates.y, rates.z
    gyroscopic = Vec3(
        (c.i_zz - c.i_yy) * q * r, (c.i_xx - c.i_zz) * r * p, (c.i_yy - c.i_xx) * p * q
    )
    # The moment of rotor acceleration is differentiated by the filter, not here.
    steady = jax.tree.map(jnp.zeros_like, measurement.rpm)
    force, moment = force_moment(vehicle, measurement.rpm, steady, measurement.body_velocity, rates)
    return gyroscopic - moment, measurement.specific_force - force
