"""Sensors of one drone: inertial unit, propeller speeds and motion capture, with their errors.

Every sample of gyro and accelerometer is

    measured = H[ true + bias + white noise ],    bias' = white noise,

with ``H`` the unit's low-pass, a second-order Butterworth. Noise and bias follow IEEE Std 952 and
Woodman, "An introduction to inertial navigation", University of Cambridge UCAM-CL-TR-696, 2007,
sections 3 and 4. A data sheet's noise density ``N`` is one-sided: a sample at ``f_s`` has the
variance ``N^2 f_s / 2`` before the filter, and its integral is a random walk of ``N^2 / 2`` per
second.

Motion capture measures the pose at its own rate, at the first sample at or after each frame time.
A frame arrives a fixed number of samples later. Frames are lost in bursts, by the two-state Markov
chain of Gilbert, "Capacity of a burst-noise channel", Bell System Technical Journal 39, 1960.

An error whose number is zero is absent.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from scipy.signal import butter
from scipy.stats import norm

from quadjax.core import quaternion
from quadjax.core.filters import advance
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.config import AccelerometerConfig, GyroConfig, SensorsConfig

DRAWS = 12 + 4 + 6 + 1  # standard normal numbers per sample
START_DRAWS = 6 + 6 + 4 + 6  # at the start
_MARGIN = 1e-4  # of a frame; keeps rounding from delaying one by a sample


@struct.dataclass
class GroundTruth:
    """The true motion of one drone at one sample."""

    position: Vec3  # m, world NED
    velocity: Vec3  # m/s, world NED
    euler: Vec3  # roll, pitch, yaw, rad
    rates: Vec3  # p, q, r, rad/s, body FRD
    specific_force: Vec3  # m/s^2, body FRD, at the inertial unit
    rpm: Rotors  # propeller speeds, rpm


@struct.dataclass
class InertialParams:
    """Gyro or accelerometer."""

    noise: jax.Array  # of a sample before the filter, rad/s or m/s^2
    bias: jax.Array  # standard deviation at the start, rad/s or m/s^2
    bias_step: jax.Array  # standard deviation of its change per sample
    forward: jax.Array  # (3,) coefficients of the low-pass
    feedback: jax.Array  # (2,)


@struct.dataclass
class SensorParams:
    """Numbers of the sensors; traced, except for the delay of a pose."""

    gyro: InertialParams
    accelerometer: InertialParams
    rpm_noise: jax.Array  # rpm
    rpm_resolution: jax.Array  # rpm
    frames_per_sample: jax.Array  # frame rate / sample rate
    position_noise: jax.Array  # m
    attitude_noise: jax.Array  # rad
    lose: jax.Array  # normal quantile below which a frame is lost after a received one
    stay_lost: jax.Array  # normal quantile below which a frame is lost after a lost one
    delay: int = struct.field(pytree_node=False, default=0)  # samples from frame to arrival


@struct.dataclass
class Fix:
    """A frame of motion capture."""

    position: Vec3  # m, world
    attitude: Quaternion
    fresh: jax.Array  # () 1.0 for a received frame, 0.0 for none


@struct.dataclass
class Measured:
    """Measurements that arrive on board at one sample."""

    gyro: Vec3  # rad/s, body
    accelerometer: Vec3  # m/s^2, body
    rpm: Rotors  # rpm
    fix: Fix  # the frame that arrives now


@struct.dataclass
class InertialState:
    """Bias and the low-pass's two memories per axis."""

    bias: Vec3
    memory_1: Vec3
    memory_2: Vec3


@struct.dataclass
class SensorState:
    """State of the sensors between samples."""

    gyro: InertialState
    accelerometer: InertialState
    clock: jax.Array  # () time since the last frame, in frames, 0 to 1
    lost: jax.Array  # () bool, whether the last frame was lost
    pending: tuple[Fix, ...]  # frames on their way, the oldest first


def sensor_params(config: SensorsConfig, sample_rate: float) -> SensorParams:
    """The sensors of a config at a constant sample rate, Hz."""
    mocap = config.mocap
    recover = 1.0 / mocap.dropout_frames
    lose = mocap.dropout * recover / (1.0 - mocap.dropout)
    numbers = {
        "rpm_noise": config.rpm.noise,
        "rpm_resolution": config.rpm.resolution,
        "frames_per_sample": mocap.rate / sample_rate,
        "position_noise": mocap.position_noise,
        "attitude_noise": mocap.attitude_noise,
        "lose": norm.ppf(lose),
        "stay_lost": norm.ppf(1.0 - recover),
    }
    return SensorParams(
        gyro=_inertial(config.gyro, sample_rate),
        accelerometer=_inertial(config.accelerometer, sample_rate),
        **{name: jnp.asarray(value, jnp.float32) for name, value in numbers.items()},
        delay=round(mocap.latency * sample_rate),
    )


def low_pass(cutoff: float, sample_rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Forward (3,) and feedback (2,) coefficients of the unit's filter; identity for 0 Hz."""
    if cutoff == 0.0:
        return np.array([1.0, 0.0, 0.0]), np.zeros(2)
    forward, feedback = butter(2, cutoff, fs=sample_rate)
    return forward, feedback[1:]


def low_pass_delay(cutoff: float, sample_rate: float) -> float:
    """Delay of that filter at low frequencies, s; it is a pure delay up to the third order."""
    if cutoff == 0.0:
        return 0.0
    return float(np.sqrt(0.5) / (sample_rate * np.tan(np.pi * cutoff / sample_rate)))


def _inertial(config: GyroConfig | AccelerometerConfig, sample_rate: float) -> InertialParams:
    forward, feedback = low_pass(config.low_pass, sample_rate)
    feedback = feedback.astype(np.float32)
    # The static gain is exactly one with the rounded coefficients.
    gain = (1.0 + feedback.astype(np.float64).sum()) / forward.sum()
    numbers = (
        config.noise * np.sqrt(0.5 * sample_rate),
        config.bias,
        config.bias_walk / np.sqrt(sample_rate),
        forward * gain,
        feedback,
    )
    return InertialParams(*(jnp.asarray(x, jnp.float32) for x in numbers))


def init(
    params: SensorParams, truth: GroundTruth, drawn: jax.Array
) -> tuple[SensorState, Measured]:
    """The sensors at the start, with filters in steady state.

    Args:
        params: of the sensors.
        truth: at the first sample.
        drawn: (START_DRAWS,) independent standard normal numbers.

    Returns:
        The state, and the first sample with a pose that has no delay.
    """
    gyro, rates = _start(params.gyro, truth.rates, drawn[0:3], drawn[3:6])
    force, accelerations = _start(
        params.accelerometer, truth.specific_force, drawn[6:9], drawn[9:12]
    )
    fix = _observe_pose(params, truth, drawn[16:22], jnp.ones(()))
    none = fix.replace(fresh=jnp.zeros(()))
    state = SensorState(gyro, force, jnp.zeros(()), jnp.zeros((), bool), (none,) * params.delay)
    return state, Measured(rates, accelerations, _rpm(params, truth.rpm, drawn[12:16]), fix)


def update(
    params: SensorParams, state: SensorState, truth: GroundTruth, drawn: jax.Array
) -> tuple[SensorState, Measured]:
    """The next sample of every sensor of one drone.

    Args:
        params: of the sensors.
        state: from ``init`` or the last ``update``.
        truth: at this sample.
        drawn: (DRAWS,) independent standard normal numbers.
    """
    gyro, rates = _sample(params.gyro, state.gyro, truth.rates, drawn[0:3], drawn[3:6])
    force, accelerations = _sample(
        params.accelerometer, state.accelerometer, truth.specific_force, drawn[6:9], drawn[9:12]
    )
    clock = state.clock + params.frames_per_sample
    due = clock >= 1.0 - _MARGIN
    lost_now = drawn[22] < jnp.where(state.lost, params.stay_lost, params.lose)
    lost = jnp.where(due, lost_now, state.lost)
    fix = _observe_pose(params, truth, drawn[16:22], (due & ~lost).astype(clock.dtype))
    pending = (*state.pending, fix)
    clock = jnp.where(due, clock - 1.0, clock)
    measured = Measured(rates, accelerations, _rpm(params, truth.rpm, drawn[12:16]), pending[0])
    return SensorState(gyro, force, clock, lost, pending[1:]), measured


def _start(
    params: InertialParams, true: Vec3, of_bias: jax.Array, of_noise: jax.Array
) -> tuple[InertialState, Vec3]:
    """A filter in steady state at this value, and one sample of it."""
    bias = Vec3.of(of_bias) * params.bias
    steady = true + bias
    b, a = params.forward, params.feedback
    memory_2 = steady * (b[2] - a[1])
    memory_1 = steady * (b[1] - a[0]) + memory_2
    return _filter(params, InertialState(bias, memory_1, memory_2), true, of_noise)


def _sample(
    params: InertialParams, state: InertialState, true: Vec3, of_bias: jax.Array, noise: jax.Array
) -> tuple[InertialState, Vec3]:
    bias = state.bias + Vec3.of(of_bias) * params.bias_step
    return _filter(params, state.replace(bias=bias), true, noise)


def _filter(
    params: InertialParams, state: InertialState, true: Vec3, noise: jax.Array
) -> tuple[InertialState, Vec3]:
    """Bias, noise, then the low-pass in transposed direct form II."""
    sensed = true + state.bias + Vec3.of(noise) * params.noise
    memory = (state.memory_1, state.memory_2)
    out, memory = advance(params.feedback, [(sensed, params.forward)], memory)
    return InertialState(state.bias, *memory), out


def _rpm(params: SensorParams, true: Rotors, noise: jax.Array) -> Rotors:
    noisy = true + Rotors.of(noise) * params.rpm_noise
    coarse = params.rpm_resolution > 0
    unit = jnp.where(coarse, params.rpm_resolution, 1.0)
    return jax.tree.map(lambda x: jnp.where(coarse, jnp.round(x / unit) * unit, x), noisy)


def _observe_pose(
    params: SensorParams, truth: GroundTruth, noise: jax.Array, fresh: jax.Array
) -> Fix:
    """The pose with its noise; the attitude's noise is the same about every axis."""
    turned = quaternion.exponential(Vec3.of(noise[3:6]) * params.attitude_noise)
    return Fix(
        position=truth.position + Vec3.of(noise[0:3]) * params.position_noise,
        attitude=quaternion.multiply(turned, quaternion.of_euler(truth.euler)),
        fresh=fresh,
    )
