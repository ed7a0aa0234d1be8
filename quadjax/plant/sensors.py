"""Sensors of one drone: inertial unit, propeller speeds and motion capture, each with its errors.

Every sample of gyro and accelerometer is

    measured = H[ true + bias + white noise ],    bias' = white noise,

with ``H`` the unit's own low-pass, a second-order Butterworth. The model of noise and bias is that
of IEEE Std 952 and Woodman, "An introduction to inertial navigation", University of Cambridge
UCAM-CL-TR-696, 2007, sections 3 and 4. A data sheet's noise density ``N`` is one-sided, so a sample
at ``f_s`` has the variance ``N^2 f_s / 2`` before the filter, and the angle that is integrated from
it a random walk of ``N^2 / 2`` per second.

Motion capture sees the pose at its own rate: the first sample at or after each frame is due. A
frame arrives a fixed number of samples later. Frames are lost in bursts, by the two-state Markov
chain of Gilbert, "Capacity of a burst-noise channel", Bell System Technical Journal 39, 1960.

Every error is zero where its number is.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from scipy.signal import butter
from scipy.stats import norm

from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import quaternion
from quadjax.plant.quaternion import Quaternion
from quadjax.plant.sensor_schema import SensorsConfig, check_sensors
from quadjax.plant.truth import Truth

DRAWS = 12 + 4 + 6 + 1  # normal numbers that a sample is made of
START_DRAWS = 6 + 6 + 4 + 6  # and the start
_MARGIN = 1e-4  # of a frame, by which rounding must not make it late


@struct.dataclass
class InertialParams:
    """Gyro or accelerometer."""

    noise: jax.Array  # of a sample before the filter, rad/s or m/s^2
    bias: jax.Array  # at the start, standard deviation, rad/s or m/s^2
    bias_step: jax.Array  # standard deviation of its change from sample to sample
    forward: jax.Array  # (3,) coefficients of the low-pass
    feedback: jax.Array  # (2,)


@struct.dataclass
class SensorParams:
    """Every number of the sensors; traced, but for how many samples a pose is late."""

    gyro: InertialParams
    accelerometer: InertialParams
    rpm_noise: jax.Array  # rpm
    rpm_resolution: jax.Array  # rpm
    frames_per_sample: jax.Array  # motion capture's rate over the sample rate
    position_noise: jax.Array  # m
    attitude_noise: jax.Array  # rad
    lose: jax.Array  # normal number below which a frame is lost after one that was not
    stay_lost: jax.Array  # normal number below which one is lost after one that was
    delay: int = struct.field(pytree_node=False, default=0)  # samples from frame to arrival


@struct.dataclass
class Fix:
    """A frame of motion capture."""

    position: Vec3  # m, world
    attitude: Quaternion
    fresh: jax.Array  # () 1.0 where there is one, 0.0 where there is none


@struct.dataclass
class Measured:
    """What arrives on board at one sample."""

    gyro: Vec3  # rad/s, body
    accelerometer: Vec3  # m/s^2, body
    rpm: Rotors  # rpm
    fix: Fix  # the frame that arrives now


@struct.dataclass
class InertialState:
    """Bias and the low-pass's two numbers of memory for each axis."""

    bias: Vec3
    memory_1: Vec3
    memory_2: Vec3


@struct.dataclass
class SensorState:
    """What the sensors carry from sample to sample."""

    gyro: InertialState
    accelerometer: InertialState
    clock: jax.Array  # () frames since the last one, 0 to 1
    lost: jax.Array  # () bool, whether the last frame was
    line: tuple[Fix, ...]  # frames on their way, the oldest first


def sensor_params(config: SensorsConfig, sample_rate: float) -> SensorParams:
    """The sensors of a config, sampled evenly.

    Args:
        config: the ``sensors`` section.
        sample_rate: Hz, at which ``update`` is called.

    Raises:
        InputError: a value that cannot be.
    """
    check_sensors(config, sample_rate)
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
    """Forward (3,) and feedback (2,) coefficients of the unit's filter; no filter for 0 Hz."""
    if cutoff == 0.0:
        return np.array([1.0, 0.0, 0.0]), np.zeros(2)
    forward, feedback = butter(2, cutoff, fs=sample_rate)
    return forward, feedback[1:]


def low_pass_delay(cutoff: float, sample_rate: float) -> float:
    """Delay of that filter at low frequencies, s: it is a pure delay up to the third order."""
    if cutoff == 0.0:
        return 0.0
    return float(np.sqrt(0.5) / (sample_rate * np.tan(np.pi * cutoff / sample_rate)))


def _inertial(config: object, sample_rate: float) -> InertialParams:
    forward, feedback = low_pass(config.low_pass, sample_rate)
    feedback = feedback.astype(np.float32)
    # The gain at rest is exactly one with the coefficients as they are rounded.
    gain = (1.0 + feedback.astype(np.float64).sum()) / forward.sum()
    numbers = (
        config.noise * np.sqrt(0.5 * sample_rate),
        config.bias,
        config.bias_walk / np.sqrt(sample_rate),
        forward * gain,
        feedback,
    )
    return InertialParams(*(jnp.asarray(x, jnp.float32) for x in numbers))


def init(params: SensorParams, truth: Truth, drawn: jax.Array) -> tuple[SensorState, Measured]:
    """The sensors at the start: a drone that has been seen by motion capture for a while.

    Args:
        params: of the sensors.
        truth: at the first sample.
        drawn: (START_DRAWS,) independent standard normal numbers.

    Returns:
        The state, and the first sample with a pose that is not late.
    """
    gyro, rates = _start(params.gyro, truth.rates, drawn[0:3], drawn[3:6])
    force, accelerations = _start(
        params.accelerometer, truth.specific_force, drawn[6:9], drawn[9:12]
    )
    fix = _look(params, truth, drawn[16:22], jnp.ones(()))
    none = fix.replace(fresh=jnp.zeros(()))
    state = SensorState(gyro, force, jnp.zeros(()), jnp.zeros((), bool), (none,) * params.delay)
    return state, Measured(rates, accelerations, _rpm(params, truth.rpm, drawn[12:16]), fix)


def update(
    params: SensorParams, state: SensorState, truth: Truth, drawn: jax.Array
) -> tuple[SensorState, Measured]:
    """The next sample of every sensor of one drone.

    Args:
        params: of the sensors.
        state: from ``init`` or the last ``update``.
        truth: at this sample.
        drawn: (DRAWS,) independent standard normal numbers; zeros for biases that stand still and
            no noise.
    """
    gyro, rates = _sample(params.gyro, state.gyro, truth.rates, drawn[0:3], drawn[3:6])
    force, accelerations = _sample(
        params.accelerometer, state.accelerometer, truth.specific_force, drawn[6:9], drawn[9:12]
    )
    clock = state.clock + params.frames_per_sample
    due = clock >= 1.0 - _MARGIN
    lost_now = drawn[22] < jnp.where(state.lost, params.stay_lost, params.lose)
    lost = jnp.where(due, lost_now, state.lost)
    fix = _look(params, truth, drawn[16:22], (due & ~lost).astype(clock.dtype))
    line = (*state.line, fix)
    clock = jnp.where(due, clock - 1.0, clock)
    measured = Measured(rates, accelerations, _rpm(params, truth.rpm, drawn[12:16]), line[0])
    return SensorState(gyro, force, clock, lost, line[1:]), measured


def _start(
    params: InertialParams, true: Vec3, of_bias: jax.Array, of_noise: jax.Array
) -> tuple[InertialState, Vec3]:
    """A filter that has seen this value for long, and one sample of it."""
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
    b, a = params.forward, params.feedback
    out = sensed * b[0] + state.memory_1
    memory_1 = state.memory_2 + sensed * b[1] - out * a[0]
    return InertialState(state.bias, memory_1, sensed * b[2] - out * a[1]), out


def _rpm(params: SensorParams, true: Rotors, noise: jax.Array) -> Rotors:
    noisy = true + Rotors.of(noise) * params.rpm_noise
    coarse = params.rpm_resolution > 0
    unit = jnp.where(coarse, params.rpm_resolution, 1.0)
    return jax.tree.map(lambda x: jnp.where(coarse, jnp.round(x / unit) * unit, x), noisy)


def _look(params: SensorParams, truth: Truth, noise: jax.Array, fresh: jax.Array) -> Fix:
    """The pose with its noise; that of the attitude is the same about every axis."""
    turned = quaternion.exponential(Vec3.of(noise[3:6]) * params.attitude_noise)
    return Fix(
        position=truth.position + Vec3.of(noise[0:3]) * params.position_noise,
        attitude=quaternion.multiply(turned, quaternion.of_euler(truth.euler)),
        fresh=fresh,
    )
