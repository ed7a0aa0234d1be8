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

A number of zero turns its error off.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.scipy.special import ndtri

from quadjax.core import quaternion
from quadjax.core.filters import LowPass, advance, butterworth
from quadjax.core.quaternion import Quaternion
from quadjax.core.traced import as_leaves
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.sensor_config import (
    AccelerometerConfig,
    GyroConfig,
    MocapConfig,
    RpmConfig,
    SensorsConfig,
)

DRAWS = 12 + 4 + 6 + 1  # standard normal numbers per sample
START_DRAWS = 6 + 6 + 4 + 6  # at the start
_MARGIN = 1e-4  # of a frame; keeps rounding from delaying one by a sample


class GroundTruth(struct.PyTreeNode):
    """The true motion of one drone at one sample."""

    position: Vec3  # m, world NED
    velocity: Vec3  # m/s, world NED
    euler: Vec3  # roll, pitch, yaw, rad
    rates: Vec3  # p, q, r, rad/s, body FRD
    specific_force: Vec3  # m/s^2, body FRD, at the inertial unit
    rpm: Rotors  # propeller speeds, rpm


class InertialParams(struct.PyTreeNode):
    """Gyro or accelerometer."""

    errors: GyroConfig | AccelerometerConfig
    low_pass: LowPass
    step: jax.Array  # s, between samples


class SensorParams(struct.PyTreeNode):
    """Numbers of the sensors; traced, except for the delay of a pose."""

    gyro: InertialParams
    accelerometer: InertialParams
    rpm: RpmConfig
    mocap: MocapConfig
    delay: int = struct.field(pytree_node=False, default=0)  # samples from frame to arrival


class Fix(struct.PyTreeNode):
    """A frame of motion capture."""

    position: Vec3  # m, world
    attitude: Quaternion
    fresh: jax.Array  # () 1.0 for a received frame, 0.0 for none


class Measured(struct.PyTreeNode):
    """Measurements that arrive on board at one sample."""

    gyro: Vec3  # rad/s, body
    accelerometer: Vec3  # m/s^2, body
    rpm: Rotors  # rpm
    fix: Fix  # the frame that arrives now


class InertialState(struct.PyTreeNode):
    """Bias and the low-pass's two memories per axis."""

    bias: Vec3
    memory_1: Vec3
    memory_2: Vec3


class SensorState(struct.PyTreeNode):
    """State of the sensors between samples."""

    gyro: InertialState
    accelerometer: InertialState
    clock: jax.Array  # () time since the last frame, in frames, 0 to 1
    lost: jax.Array  # () bool, whether the last frame was lost
    pending: tuple[Fix, ...]  # frames on their way, the oldest first


def sensor_params(config: SensorsConfig, sample_rate: float) -> SensorParams:
    """The sensors of a config at a constant sample rate, Hz."""
    return SensorParams(
        gyro=_inertial(config.gyro, sample_rate),
        accelerometer=_inertial(config.accelerometer, sample_rate),
        rpm=as_leaves(config.rpm),
        mocap=as_leaves(config.mocap),
        delay=round(config.mocap.latency * sample_rate),
    )


def _inertial(errors: GyroConfig | AccelerometerConfig, sample_rate: float) -> InertialParams:
    if errors.low_pass == 0.0:
        one, none = jnp.array([1.0, 0.0, 0.0]), jnp.zeros(3)
        low_pass = LowPass(feedback=jnp.zeros(2), forward=one, derivative=none)
    else:
        low_pass = butterworth(sample_rate, errors.low_pass)
    return InertialParams(as_leaves(errors), low_pass, jnp.float32(1.0 / sample_rate))


def low_pass_delay(cutoff: float, sample_rate: float) -> float:
    """Delay of a unit's filter at low frequencies, s; it is a pure delay up to the third order."""
    if cutoff == 0.0:
        return 0.0
    return float(np.sqrt(0.5) / (sample_rate * np.tan(np.pi * cutoff / sample_rate)))


def init(
    params: SensorParams, truth: GroundTruth, draws: jax.Array
) -> tuple[SensorState, Measured]:
    """The sensors at the start, with filters in steady state, from (START_DRAWS,) normal numbers.

    Returns:
        The state, and the first sample with a pose that has no delay.
    """
    gyro, rates = _start(params.gyro, truth.rates, draws[0:3], draws[3:6])
    force, accelerations = _start(
        params.accelerometer, truth.specific_force, draws[6:9], draws[9:12]
    )
    fix = _observe_pose(params.mocap, truth, draws[16:22], jnp.ones(()))
    none = fix.replace(fresh=jnp.zeros(()))
    state = SensorState(gyro, force, jnp.zeros(()), jnp.zeros((), bool), (none,) * params.delay)
    return state, Measured(rates, accelerations, _rpm(params.rpm, truth.rpm, draws[12:16]), fix)


def update(
    params: SensorParams, state: SensorState, truth: GroundTruth, draws: jax.Array
) -> tuple[SensorState, Measured]:
    """The next sample of every sensor of one drone, from (DRAWS,) independent normal numbers."""
    gyro, rates = _sample(params.gyro, state.gyro, truth.rates, draws[0:3], draws[3:6])
    force, accelerations = _sample(
        params.accelerometer, state.accelerometer, truth.specific_force, draws[6:9], draws[9:12]
    )
    clock = state.clock + params.mocap.rate * params.gyro.step
    due = clock >= 1.0 - _MARGIN
    lost = jnp.where(due, draws[22] < _loss_quantile(params.mocap, state.lost), state.lost)
    fix = _observe_pose(params.mocap, truth, draws[16:22], (due & ~lost).astype(clock.dtype))
    pending = (*state.pending, fix)
    clock = jnp.where(due, clock - 1.0, clock)
    measured = Measured(rates, accelerations, _rpm(params.rpm, truth.rpm, draws[12:16]), pending[0])
    return SensorState(gyro, force, clock, lost, pending[1:]), measured


def _loss_quantile(mocap: MocapConfig, lost: jax.Array) -> jax.Array:
    """Normal quantile () below which a frame is lost, after a lost frame or a received one."""
    recover = 1.0 / mocap.dropout_frames
    lose = mocap.dropout * recover / (1.0 - mocap.dropout)
    return jnp.where(lost, ndtri(1.0 - recover), ndtri(lose))


def _start(
    params: InertialParams, true: Vec3, of_bias: jax.Array, of_noise: jax.Array
) -> tuple[InertialState, Vec3]:
    """A filter in steady state at this value, and one sample of it."""
    bias = Vec3.of(of_bias) * params.errors.bias
    steady = true + bias
    b, a = params.low_pass.forward, params.low_pass.feedback
    memory_2 = steady * (b[2] - a[1])
    memory_1 = steady * (b[1] - a[0]) + memory_2
    return _filter(params, InertialState(bias, memory_1, memory_2), true, of_noise)


def _sample(
    params: InertialParams, state: InertialState, true: Vec3, of_bias: jax.Array, noise: jax.Array
) -> tuple[InertialState, Vec3]:
    bias = state.bias + Vec3.of(of_bias) * (params.errors.bias_walk * jnp.sqrt(params.step))
    return _filter(params, state.replace(bias=bias), true, noise)


def _filter(
    params: InertialParams, state: InertialState, true: Vec3, noise: jax.Array
) -> tuple[InertialState, Vec3]:
    """Bias, noise, then the low-pass in transposed direct form II."""
    deviation = params.errors.noise * jnp.sqrt(0.5 / params.step)
    signal = true + state.bias + Vec3.of(noise) * deviation
    memory = (state.memory_1, state.memory_2)
    out, memory = advance(params.low_pass.feedback, [(signal, params.low_pass.forward)], memory)
    return InertialState(state.bias, *memory), out


def _rpm(errors: RpmConfig, true: Rotors, noise: jax.Array) -> Rotors:
    noisy = true + Rotors.of(noise) * errors.noise
    coarse = errors.resolution > 0
    unit = jnp.where(coarse, errors.resolution, 1.0)
    return jax.tree.map(lambda x: jnp.where(coarse, jnp.round(x / unit) * unit, x), noisy)


def _observe_pose(
    mocap: MocapConfig, truth: GroundTruth, noise: jax.Array, fresh: jax.Array
) -> Fix:
    """The pose with its noise; the attitude's noise is the same about every axis."""
    turned = quaternion.exponential(Vec3.of(noise[3:6]) * mocap.attitude_noise)
    return Fix(
        position=truth.position + Vec3.of(noise[0:3]) * mocap.position_noise,
        attitude=quaternion.multiply(turned, quaternion.of_euler(truth.euler)),
        fresh=fresh,
    )
