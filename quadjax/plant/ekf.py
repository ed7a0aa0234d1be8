"""Extended Kalman filter of inertial unit and motion capture: motion and sensor biases.

An error-state filter with a quaternion (Sola, arXiv 1711.02508, sections 5 to 7, attitude errors
in the world frame). Gyro and accelerometer predict the estimate, poses correct it. It has no
singularity at a pitch of 90 deg. The fifteen errors, in this order:

    position (m, world), velocity (m/s, world), attitude (rad, world: the rotation vector that
    turns the estimated attitude into the true one, ``q_true = exp(error) * q``),
    gyro bias (rad/s, body), accelerometer bias (m/s^2, body).

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

Functions are of one drone; batch with ``vmap``.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core import quaternion
from quadjax.core.materialize import materialized
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Mat3, Vec3, apply, skew
from quadjax.plant.sensor_config import SensorsConfig
from quadjax.plant.sensors import Fix, Measured, low_pass_delay

POSE = (0, 1, 2, 6, 7, 8)  # the errors that a pose measures: position and attitude
# Assumed in addition to the sensors' own errors.
REFERENCE_RATE = 500.0  # Hz, of the noise that stands for motion between two samples:
GYRO_NOISE = 2.0e-4  # rad/s/sqrt(Hz)
FORCE_NOISE = 6.0e-3  # m/s^2/sqrt(Hz)
GYRO_BIAS_WALK = 1.0e-5  # rad/s/sqrt(s)
FORCE_BIAS_WALK = 1.0e-3  # m/s^2/sqrt(s)
POSITION_NOISE = 1.0e-4  # m, of a pose
ATTITUDE_NOISE = 1.0e-4  # rad
# Standard deviations of the first estimate.
START_POSITION = 3.0e-3  # m, added to a pose's
START_VELOCITY = 0.5  # m/s; the first estimate is zero
START_ATTITUDE = 5.0e-3  # rad, added to a pose's
START_GYRO_BIAS = 1.0e-3  # rad/s, added to the sensor's
START_FORCE_BIAS = 1.0e-2  # m/s^2, added to the sensor's


class EkfParams(struct.PyTreeNode):
    """Parameters of the filter; traced, except for its lag in samples."""

    step: jax.Array  # s between samples
    gravity: jax.Array  # m/s^2
    noise: jax.Array  # (15, 15) covariance that one step adds
    pose_variance: jax.Array  # (6,) of a pose's position, m^2, and attitude, rad^2
    start: jax.Array  # (15,) variances of the first estimate
    late: jax.Array  # s, delay of inertial samples
    offset: jax.Array  # s, from the delayed estimate to a pose
    gyro_shift: jax.Array  # fraction of a step by which the gyro is delayed to align it
    force_shift: jax.Array  # the same of the accelerometer
    gyro_lead: jax.Array  # steps by which the gyro is extrapolated to the present
    force_lead: jax.Array  # the same of the accelerometer
    lag: int = struct.field(pytree_node=False, default=0)  # samples in the buffer


class MotionEstimate(struct.PyTreeNode):
    """The estimated motion at one instant."""

    position: Vec3  # m, world
    velocity: Vec3  # m/s, world
    attitude: Quaternion
    gyro_bias: Vec3  # rad/s, body
    force_bias: Vec3  # m/s^2, body


class InertialSample(struct.PyTreeNode):
    """An inertial sample."""

    gyro: Vec3  # rad/s, body
    force: Vec3  # m/s^2, body
    step: jax.Array  # () s since the sample before; 0 at the start


class EkfState(struct.PyTreeNode):
    """The filter at the delayed instant, and the samples since."""

    motion: MotionEstimate
    covariance: jax.Array  # (15, 15) of the errors
    last: InertialSample  # processed last
    waiting: InertialSample  # buffered: leaves (samples,), the oldest first
    newest: InertialSample  # as measured, gyro and accelerometer not aligned
    before: InertialSample  # the one before it


def ekf_params(sensors: SensorsConfig, sample_rate: float, gravity: float = 9.81) -> EkfParams:
    """The filter for the sensors of a config.

    Args:
        sensors: the ``sensors`` section.
        sample_rate: Hz.
        gravity: m/s^2.
    """
    delays = [
        low_pass_delay(unit.low_pass, sample_rate) for unit in (sensors.gyro, sensors.accelerometer)
    ]
    late = max(delays)
    latency = round(sensors.mocap.latency * sample_rate) / sample_rate
    lag = max(0, round((latency - late) * sample_rate))
    position = math.hypot(sensors.mocap.position_noise, POSITION_NOISE)
    attitude = math.hypot(sensors.mocap.attitude_noise, ATTITUDE_NOISE)
    start = (
        # The first pose has no delay and the first inertial sample has ``late`` seconds; the
        # distance in between is as uncertain as the velocity.
        math.hypot(position, START_POSITION, late * START_VELOCITY),
        START_VELOCITY,
        math.hypot(attitude, START_ATTITUDE),
        math.hypot(sensors.gyro.bias, START_GYRO_BIAS),
        math.hypot(sensors.accelerometer.bias, START_FORCE_BIAS),
    )
    numbers = {
        "step": 1.0 / sample_rate,
        "gravity": gravity,
        "noise": _noise(sensors, sample_rate),
        "pose_variance": np.repeat([position**2, attitude**2], 3),
        "start": np.repeat(np.square(start), 3),
        "late": late,
        "offset": lag / sample_rate + late - latency,
        "gyro_shift": (late - delays[0]) * sample_rate,
        "force_shift": (late - delays[1]) * sample_rate,
        "gyro_lead": delays[0] * sample_rate,
        "force_lead": delays[1] * sample_rate,
    }
    arrays = {name: jnp.asarray(x, jnp.float32) for name, x in numbers.items()}
    return EkfParams(**arrays, lag=lag)


def _noise(sensors: SensorsConfig, sample_rate: float) -> np.ndarray:
    """Covariance (15, 15) that the noise of the sensors adds in one step.

    Between two samples a step ``T`` apart the trapezoidal rule has an error of ``T^3 / 12`` times
    the signal's second derivative; as white noise its density grows with ``T^2.5``. The noise of
    the velocity also moves the position by half a step of it.
    """
    gyro, force = sensors.gyro, sensors.accelerometer
    between, step = (REFERENCE_RATE / sample_rate) ** 2.5, 1.0 / sample_rate
    densities = (
        0.0,
        0.5 * (force.noise**2 + (between * FORCE_NOISE) ** 2),
        0.5 * (gyro.noise**2 + (between * GYRO_NOISE) ** 2),
        gyro.bias_walk**2 + GYRO_BIAS_WALK**2,
        force.bias_walk**2 + FORCE_BIAS_WALK**2,
    )
    enters = np.eye(5)
    enters[0, 1] = 0.5 * step
    return np.kron(enters @ np.diag(densities) @ enters.T * step, np.eye(3))


def init(params: EkfParams, measured: Measured) -> EkfState:
    """The filter at the start; velocity and biases are unknown.

    ``measured`` is the first sample, with a pose without delay.
    """
    zero = measured.gyro * 0.0
    motion = MotionEstimate(measured.fix.position, zero, measured.fix.attitude, zero, zero)
    sample = InertialSample(measured.gyro, measured.accelerometer, zero.x)
    waiting = jax.tree.map(lambda x: jnp.repeat(x, params.lag), sample)
    return EkfState(motion, jnp.diag(params.start), sample, waiting, sample, sample)


def update(params: EkfParams, state: EkfState, measured: Measured) -> EkfState:
    """Process the next sample of one drone; its pose is used if it is ``fresh``."""
    newest = InertialSample(measured.gyro, measured.accelerometer, params.step)
    aligned = InertialSample(
        newest.gyro + (state.newest.gyro - newest.gyro) * params.gyro_shift,
        newest.force + (state.newest.force - newest.force) * params.force_shift,
        params.step,
    )
    line = jax.tree.map(lambda xs, x: jnp.append(xs, x), state.waiting, aligned)
    sample = jax.tree.map(lambda xs: xs[0], line)
    opaque_true, known = params.step > 0.0, (state.motion, state.covariance)
    motion, covariance = predict(params, *known, state.last, sample, opaque_true=opaque_true)
    motion, covariance = correct(
        params, motion, covariance, sample, measured.fix, opaque_true=opaque_true
    )
    waiting = jax.tree.map(lambda xs: xs[1:], line)
    return EkfState(motion, covariance, sample, waiting, newest, state.newest)


@materialized()
def predict(
    params: EkfParams,
    motion: MotionEstimate,
    covariance: jax.Array,
    before: InertialSample,
    after: InertialSample,
) -> tuple[MotionEstimate, jax.Array]:
    """Estimate and covariance ``F P F^T + Q`` from one inertial sample to the next.

    ``motion`` is that at ``before``, ``covariance`` (15, 15) that of its errors.
    """
    moved, f = advance(params.gravity, motion, before, after, opaque_true=params.step > 0.0)
    grown = f @ covariance @ f.T + params.noise * (after.step / params.step)
    return moved, grown


@materialized()
def advance(
    gravity: jax.Array, motion: MotionEstimate, before: InertialSample, after: InertialSample
) -> tuple[MotionEstimate, jax.Array]:
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
    return moved, transition(step, turn, middle)


def transition(step: jax.Array, turn: Vec3, rotation: Mat3) -> jax.Array:
    """The transition ``F`` (15, 15) of the errors over one step, without terms of its square.

    Args:
        step: () s.
        turn: the velocity's change by specific force, m/s, world.
        rotation: body to world, in the middle of the step.
    """
    one, none = jnp.eye(3), jnp.zeros((3, 3))
    s, r, half = skew(turn).array(), rotation.array() * step, 0.5 * step
    return jnp.block(
        [
            [one, one * step, -half * s, none, -half * r],
            [none, one, -s, none, -r],
            [none, none, one, -r, none],
            [none, none, none, one, none],
            [none, none, none, none, one],
        ]
    )


@materialized()
def correct(
    params: EkfParams, motion: MotionEstimate, covariance: jax.Array, at: InertialSample, fix: Fix
) -> tuple[MotionEstimate, jax.Array]:
    """Correct the motion at the instant of ``at`` with a pose, if it is ``fresh``.

    The noise of its six numbers is independent, so each is processed by itself, with a division
    in place of the inverse of a matrix (Maybeck, "Stochastic models, estimation, and control",
    volume 1, 1979, section 5.10). A number measures one error: ``P H^T`` is a row of ``P``,
    (15, 15). Rates and force of ``at``, the sample processed last, bridge the offset to the pose.
    """
    innovations = _innovation(params, motion, at, fix, opaque_true=params.step > 0.0)
    errors = jnp.zeros(15)
    for number, row in enumerate(POSE):
        column = covariance[row]
        gain = column / (column[row] + params.pose_variance[number]) * fix.fresh
        errors = errors + gain * (innovations[number] - errors[row])
        covariance = covariance - gain[:, None] * column[None, :]
    position, velocity, attitude, gyro, force = (Vec3.of(e) for e in errors.reshape(5, 3))
    turned = quaternion.multiply(quaternion.exponential(attitude), motion.attitude)
    corrected = MotionEstimate(
        motion.position + position,
        motion.velocity + velocity,
        quaternion.normalized(turned),
        motion.gyro_bias + gyro,
        motion.force_bias + force,
    )
    return corrected, 0.5 * (covariance + covariance.T)


@materialized()
def _innovation(
    params: EkfParams, motion: MotionEstimate, at: InertialSample, fix: Fix
) -> jax.Array:
    """The numbers (6,) of a pose less those that the estimate expects: m and rad, world."""
    force = apply(quaternion.matrix(motion.attitude), at.force - motion.force_bias)
    acceleration = force.replace(z=force.z + params.gravity)
    expected = (
        motion.position + (motion.velocity + acceleration * (0.5 * params.offset)) * params.offset
    )
    turned = quaternion.exponential((at.gyro - motion.gyro_bias) * params.offset)
    attitude = quaternion.multiply(motion.attitude, turned)
    error = quaternion.multiply(fix.attitude, quaternion.conjugate(attitude))
    return jnp.concatenate([(fix.position - expected).array(), quaternion.logarithm(error).array()])


def estimate(params: EkfParams, state: EkfState) -> tuple[MotionEstimate, Vec3]:
    """The current motion and body rates, rad/s, of one drone.

    The motion is the delayed estimate predicted over the buffered samples. Rates and the last
    specific force are the newest sample, extrapolated by the low-pass's delay along the last
    difference.
    """
    newest, before, motion = state.newest, state.before, state.motion
    gyro = newest.gyro + (newest.gyro - before.gyro) * params.gyro_lead
    force = newest.force + (newest.force - before.force) * params.force_lead

    def one(
        carry: tuple[MotionEstimate, InertialSample], sample: InertialSample
    ) -> tuple[tuple[MotionEstimate, InertialSample], None]:
        return (advance(params.gravity, *carry, sample)[0], sample), None

    (motion, last), _ = jax.lax.scan(one, (motion, state.last), state.waiting)
    # The rest has no measurement: extrapolated rates and force.
    now = InertialSample(gyro, force, params.late)
    present, _ = advance(params.gravity, motion, last, now)
    return present, gyro - present.gyro_bias
