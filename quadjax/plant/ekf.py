"""Extended Kalman filter of inertial unit and motion capture: motion and sensor biases.

An error-state filter with a quaternion (Sola, arXiv 1711.02508, sections 5 to 7, attitude errors
in the world frame). Gyro and accelerometer predict the estimate, poses correct it. It has no
singularity at a pitch of 90 deg.

Delayed poses. A pose arrives some time after it was taken, so the filter runs with that delay:
inertial samples wait in a buffer until the poses of their time arrive, and each pose corrects the
estimate of the instant at which it was taken. The present estimate is the delayed one predicted
over the buffered samples, recomputed at every sample (the delayed time horizon of Khosravian,
Trumpf, Mahony and Hamel, "Recursive attitude estimation in the presence of multi-rate and
multi-delay vector measurements", American Control Conference 2015, and of PX4's EKF2). Without
latency the buffer is empty. A lost frame changes nothing.

Delayed inertial samples. The unit's low-pass is a pure delay ``d`` to the third order, so a sample
is the value of ``d`` ago. The time of the delayed estimate then differs from the pose's by an
``offset`` of at most half a sample, which the estimated velocity and rates bridge; the present is
``d`` after the last sample.

``init`` and ``update`` advance the filter, ``quadjax.plant.estimate`` computes the present
estimate. Functions are of one drone; batch with ``vmap``.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import quaternion
from quadjax.core.materialize import Caller, call_directly, call_materialized_forward
from quadjax.core.matrix import apply
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Vec3
from quadjax.plant import covariance as cov
from quadjax.plant.covariance import Covariance, Transition
from quadjax.plant.ekf_params import EkfParams
from quadjax.plant.sensors import Fix, Measured


@struct.dataclass
class MotionEstimate:
    """The estimate at the delayed instant."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    attitude: Quaternion
    gyro_bias: Vec3  # rad/s, body
    force_bias: Vec3  # m/s^2, body


@struct.dataclass
class InertialSample:
    """An inertial sample."""

    gyro: Vec3  # rad/s, body
    force: Vec3  # m/s^2, body
    step: jax.Array  # () s since the sample before; 0 at the start


@struct.dataclass
class Roughness:
    """Mean squares of the second differences of the measurements."""

    gyro: Vec3  # (rad/s)^2
    force: Vec3  # (m/s^2)^2


@struct.dataclass
class EkfState:
    """The filter at the delayed instant, and the samples since."""

    motion: MotionEstimate
    covariance: Covariance
    last: InertialSample  # processed last
    waiting: tuple[InertialSample, ...]  # buffered, the oldest first
    newest: InertialSample  # as measured, gyro and accelerometer not aligned
    before: InertialSample  # the one before it
    roughness: Roughness


def init(params: EkfParams, measured: Measured) -> EkfState:
    """The filter at the start, from a pose; velocity and biases are unknown.

    Args:
        params: of the filter.
        measured: the first sample, with a pose without delay.
    """
    zero = Vec3(*(jnp.zeros_like(x) for x in measured.gyro.components()))
    motion = MotionEstimate(measured.fix.position, zero, measured.fix.attitude, zero, zero)
    start = cov.diagonal_covariance(tuple(std + zero.x for std in params.start))
    sample = InertialSample(measured.gyro, measured.accelerometer, zero.x)
    waiting = (sample,) * params.lag
    return EkfState(motion, start, sample, waiting, sample, sample, Roughness(zero, zero))


def update(params: EkfParams, state: EkfState, measured: Measured) -> EkfState:
    """Process the next sample of one drone.

    Args:
        params: of the filter.
        state: from ``init`` or the last ``update``.
        measured: the sample; its pose is used if it is ``fresh``.
    """
    call = caller(params)
    newest = InertialSample(measured.gyro, measured.accelerometer, params.step)
    aligned = InertialSample(
        newest.gyro + (state.newest.gyro - newest.gyro) * params.gyro_shift,
        newest.force + (state.newest.force - newest.force) * params.force_shift,
        params.step,
    )
    taken, *waiting = (*state.waiting, aligned)
    motion, covariance = predict(params, state.motion, state.covariance, state.last, taken, call)
    motion, covariance = correct(params, motion, covariance, taken, measured.fix, call)
    roughness = _roughness(params, state, newest)
    return EkfState(motion, covariance, taken, tuple(waiting), newest, state.newest, roughness)


def caller(params: EkfParams) -> Caller:
    """A ``Caller`` that materializes values; see ``quadjax.core.materialize``."""
    opaque_true = params.step > 0
    return lambda function, *arguments: call_materialized_forward(function, opaque_true, *arguments)


def predict(
    params: EkfParams,
    motion: MotionEstimate,
    covariance: Covariance,
    before: InertialSample,
    after: InertialSample,
    call: Caller = call_directly,
) -> tuple[MotionEstimate, Covariance]:
    """Predict estimate and covariance from one inertial sample to the next.

    Args:
        params: of the filter.
        motion: at ``before``.
        covariance: of its errors.
        before: the sample processed last.
        after: the sample to process.
        call: calls a function; see ``quadjax.core.materialize``.
    """
    moved, transition = call(advance, params.gravity, motion, before, after)
    return moved, cov.predict(covariance, transition, params.growth(after.step), call)


def advance(
    gravity: jax.Array, motion: MotionEstimate, before: InertialSample, after: InertialSample
) -> tuple[MotionEstimate, Transition]:
    """The motion one sample later, by the trapezoidal rule, and the transition of its errors."""
    step = after.step
    angle = ((before.gyro + after.gyro) * 0.5 - motion.gyro_bias) * step
    force = (before.force + after.force) * 0.5 - motion.force_bias
    half = quaternion.exponential(angle * 0.5)
    between = quaternion.multiply(motion.attitude, half)
    middle = quaternion.matrix(between)
    turn = apply(middle, force) * step
    change = turn.replace(z=turn.z + gravity * step)
    moved = motion.replace(
        position=motion.position + (motion.velocity + change * 0.5) * step,
        velocity=motion.velocity + change,
        attitude=quaternion.normalized(quaternion.multiply(between, half)),
    )
    return moved, Transition(step, turn, middle * step)


def correct(
    params: EkfParams,
    motion: MotionEstimate,
    covariance: Covariance,
    at: InertialSample,
    fix: Fix,
    call: Caller = call_directly,
) -> tuple[MotionEstimate, Covariance]:
    """Correct with a pose: its position first, then its attitude.

    Args:
        params: of the filter.
        motion: at the instant of ``at``.
        covariance: of its errors.
        at: the sample processed last; its rates and force bridge the offset to the pose.
        fix: the pose; without effect unless it is ``fresh``.
        call: calls a function; see ``quadjax.core.materialize``.
    """
    motion, covariance = call(_correct_position, params, motion, covariance, at, fix)
    return call(_correct_attitude, params, motion, covariance, at, fix)


def _correct_position(
    params: EkfParams, motion: MotionEstimate, covariance: Covariance, at: InertialSample, fix: Fix
) -> tuple[MotionEstimate, Covariance]:
    force = apply(quaternion.matrix(motion.attitude), at.force - motion.force_bias)
    acceleration = force.replace(z=force.z + params.gravity)
    expected = (
        motion.position + (motion.velocity + acceleration * (0.5 * params.offset)) * params.offset
    )
    corrections, covariance = cov.correct(
        covariance, cov.POSITION, fix.position - expected, params.position_variance, fix.fresh
    )
    return _corrected(motion, corrections), covariance


def _correct_attitude(
    params: EkfParams, motion: MotionEstimate, covariance: Covariance, at: InertialSample, fix: Fix
) -> tuple[MotionEstimate, Covariance]:
    turned = quaternion.exponential((at.gyro - motion.gyro_bias) * params.offset)
    expected = quaternion.multiply(motion.attitude, turned)
    error = quaternion.multiply(fix.attitude, quaternion.conjugate(expected))
    corrections, covariance = cov.correct(
        covariance,
        cov.ATTITUDE,
        quaternion.logarithm(error),
        params.attitude_variance,
        fix.fresh,
    )
    return _corrected(motion, corrections), covariance


def _corrected(motion: MotionEstimate, corrections: tuple[Vec3, ...]) -> MotionEstimate:
    position, velocity, attitude, gyro_bias, force_bias = corrections
    turned = quaternion.multiply(quaternion.exponential(attitude), motion.attitude)
    return MotionEstimate(
        motion.position + position,
        motion.velocity + velocity,
        quaternion.normalized(turned),
        motion.gyro_bias + gyro_bias,
        motion.force_bias + force_bias,
    )


def _roughness(params: EkfParams, state: EkfState, newest: InertialSample) -> Roughness:
    def mean(old: Vec3, now: Vec3, before: Vec3, earlier: Vec3) -> Vec3:
        second = now - before * 2.0 + earlier
        return old + (second * second - old) * params.roughness_rate

    before, earlier = state.newest, state.before
    return Roughness(
        mean(state.roughness.gyro, newest.gyro, before.gyro, earlier.gyro),
        mean(state.roughness.force, newest.force, before.force, earlier.force),
    )
