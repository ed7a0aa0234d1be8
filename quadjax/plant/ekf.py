"""The extended Kalman filter on board: inertial unit and motion capture to motion and biases.

An error-state filter with a quaternion (Sola, arXiv 1711.02508, sections 5 to 7, errors of the
attitude in the world frame): gyro and accelerometer carry the estimate on, poses correct it.
Nothing is singular at a pitch of 90 deg.

Late poses. A pose that arrives now was taken some time ago, so the filter itself runs that far
behind: inertial samples wait in a buffer and are taken in when the poses of their own time
arrive. Each pose then corrects the estimate of the instant at which it was taken, with the gain
that is right for it. What the drone is told is the delayed estimate carried on over the waiting
samples, from scratch at every sample, so that a correction or a new bias reaches the present at
once and in full (the time horizon of Khosravian, Trumpf, Mahony and Hamel, "Recursive attitude
estimation in the presence of multi-rate and multi-delay vector measurements", American Control
Conference 2015, and of the filter EKF2 of PX4). With no latency the buffer is empty and this is
the textbook filter. A frame that was lost changes nothing.

Late inertial samples. The unit's own low-pass is, to the third order, a pure delay ``d``, so a
sample is taken as what was true ``d`` ago. The delayed estimate is then of a time within half a
sample of the pose's, an ``offset`` that the estimated velocity and rates bridge; and the present
is ``d`` beyond the last sample.

``init`` and ``update`` carry the filter from sample to sample, ``estimate`` says what it believes
(``quadjax.plant.estimate``). All of it is of one drone: batch with ``vmap``.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.materialize import Keep, call, staged_values
from quadjax.core.vectors import Vec3
from quadjax.plant import covariance as cov
from quadjax.plant import quaternion
from quadjax.plant.covariance import Covariance, Growth, Transition
from quadjax.plant.ekf_params import EkfParams
from quadjax.plant.matrix import apply
from quadjax.plant.quaternion import Quaternion
from quadjax.plant.sensors import Fix, Measured


@struct.dataclass
class Motion:
    """What the filter estimates, at its delayed instant."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    attitude: Quaternion
    gyro_bias: Vec3  # rad/s, body
    force_bias: Vec3  # m/s^2, body


@struct.dataclass
class Sample:
    """An inertial sample."""

    gyro: Vec3  # rad/s, body
    force: Vec3  # m/s^2, body
    step: jax.Array  # () s since the sample before; 0 at the start


@struct.dataclass
class Unrest:
    """Mean squares of the second differences of what is measured: how much it surprises."""

    gyro: Vec3  # (rad/s)^2
    force: Vec3  # (m/s^2)^2


@struct.dataclass
class EkfState:
    """The filter at its delayed instant, and the samples since."""

    motion: Motion
    covariance: Covariance
    last: Sample  # taken in last
    waiting: tuple[Sample, ...]  # not taken in yet, the oldest first
    newest: Sample  # as measured: gyro and accelerometer not brought to the same instant
    before: Sample  # the one before it
    unrest: Unrest


def init(params: EkfParams, measured: Measured) -> EkfState:
    """The filter at the start, from a pose and no knowledge of velocity and biases.

    Args:
        params: of the filter.
        measured: the sensors' first sample, with a pose that is not late.
    """
    zero = Vec3(*(jnp.zeros_like(x) for x in measured.gyro.components()))
    motion = Motion(measured.fix.position, zero, measured.fix.attitude, zero, zero)
    start = cov.diagonal_covariance(tuple(std + zero.x for std in params.start))
    sample = Sample(measured.gyro, measured.accelerometer, zero.x)
    waiting = (sample,) * params.lag
    return EkfState(motion, start, sample, waiting, sample, sample, Unrest(zero, zero))


def update(params: EkfParams, state: EkfState, measured: Measured) -> EkfState:
    """Take in the next sample of one drone.

    Args:
        params: of the filter.
        state: from ``init`` or the last ``update``.
        measured: what arrives at this sample; the pose counts where it is ``fresh``.
    """
    keep = keeper(params)
    newest = Sample(measured.gyro, measured.accelerometer, params.step)
    aligned = Sample(
        newest.gyro + (state.newest.gyro - newest.gyro) * params.gyro_shift,
        newest.force + (state.newest.force - newest.force) * params.force_shift,
        params.step,
    )
    taken, *waiting = (*state.waiting, aligned)
    motion, covariance = predict(params, state.motion, state.covariance, state.last, taken, keep)
    motion, covariance = correct(params, motion, covariance, taken, measured.fix, keep)
    unrest = _unrest(params, state, newest)
    return EkfState(motion, covariance, taken, tuple(waiting), newest, state.newest, unrest)


def keeper(params: EkfParams) -> Keep:
    """Calls functions so that their values are computed once; see ``quadjax.core.materialize``."""
    always = params.step > 0
    return lambda function, *arguments: staged_values(function, always, *arguments)


def predict(
    params: EkfParams,
    motion: Motion,
    covariance: Covariance,
    before: Sample,
    after: Sample,
    keep: Keep = call,
) -> tuple[Motion, Covariance]:
    """Carry estimate and covariance on from one inertial sample to the next.

    Args:
        params: of the filter.
        motion: at ``before``.
        covariance: of its errors.
        before: the sample taken in last.
        after: the sample to take in.
        keep: calls a function in a way that its values are computed once.
    """
    moved, transition = keep(advance, params.gravity, motion, before, after)
    densities = (params.force_density, params.gyro_density, params.gyro_walk, params.force_walk)
    growth = Growth(*(density * after.step for density in densities))
    return moved, cov.predict(covariance, transition, growth, keep)


def advance(
    gravity: jax.Array, motion: Motion, before: Sample, after: Sample
) -> tuple[Motion, Transition]:
    """The motion one sample later, by the trapezoidal rule, and the errors' transition."""
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
        attitude=quaternion.normalised(quaternion.multiply(between, half)),
    )
    return moved, Transition(step, turn, middle * step)


def correct(
    params: EkfParams,
    motion: Motion,
    covariance: Covariance,
    at: Sample,
    fix: Fix,
    keep: Keep = call,
) -> tuple[Motion, Covariance]:
    """Correct with a pose: its position first, then its attitude.

    Args:
        params: of the filter.
        motion: at the instant of ``at``.
        covariance: of its errors.
        at: the sample taken in last: its rates and force bridge the offset to the pose's instant.
        fix: the pose; nothing changes unless it is ``fresh``.
        keep: calls a function in a way that its values are computed once.
    """
    motion, covariance = keep(_correct_position, params, motion, covariance, at, fix)
    return keep(_correct_attitude, params, motion, covariance, at, fix)


def _correct_position(
    params: EkfParams, motion: Motion, covariance: Covariance, at: Sample, fix: Fix
) -> tuple[Motion, Covariance]:
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
    params: EkfParams, motion: Motion, covariance: Covariance, at: Sample, fix: Fix
) -> tuple[Motion, Covariance]:
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


def _corrected(motion: Motion, corrections: tuple[Vec3, ...]) -> Motion:
    position, velocity, attitude, gyro_bias, force_bias = corrections
    turned = quaternion.multiply(quaternion.exponential(attitude), motion.attitude)
    return Motion(
        motion.position + position,
        motion.velocity + velocity,
        quaternion.normalised(turned),
        motion.gyro_bias + gyro_bias,
        motion.force_bias + force_bias,
    )


def _unrest(params: EkfParams, state: EkfState, newest: Sample) -> Unrest:
    def mean(old: Vec3, now: Vec3, before: Vec3, earlier: Vec3) -> Vec3:
        second = now - before * 2.0 + earlier
        return old + (second * second - old) * params.unrest_rate

    before, earlier = state.newest, state.before
    return Unrest(
        mean(state.unrest.gyro, newest.gyro, before.gyro, earlier.gyro),
        mean(state.unrest.force, newest.force, before.force, earlier.force),
    )
