"""Parameters of the navigation filter, derived from those of the sensors."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.plant.config import SensorsConfig
from quadjax.plant.sensors import low_pass_delay

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


def ekf_params(sensors: SensorsConfig, sample_rate: float, gravity: float = 9.81) -> EkfParams:
    """The filter for the sensors of a config.

    Args:
        sensors: the ``sensors`` section.
        sample_rate: Hz.
        gravity: m/s^2.
    """
    timing, lag = _timing(sensors, sample_rate)
    position = math.hypot(sensors.mocap.position_noise, POSITION_NOISE)
    attitude = math.hypot(sensors.mocap.attitude_noise, ATTITUDE_NOISE)
    start = (
        # The first pose has no delay and the first inertial sample has ``late`` seconds; the
        # distance in between is as uncertain as the velocity.
        math.hypot(position, START_POSITION, timing["late"] * START_VELOCITY),
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
    }
    arrays = {name: jnp.asarray(x, jnp.float32) for name, x in (numbers | timing).items()}
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


def _timing(sensors: SensorsConfig, sample_rate: float) -> tuple[dict[str, float], int]:
    """Delays and alignment of the sensors, and the lag of the filter in samples."""
    units = (sensors.gyro, sensors.accelerometer)
    delays = [low_pass_delay(unit.low_pass, sample_rate) for unit in units]
    late = max(delays)
    latency = round(sensors.mocap.latency * sample_rate) / sample_rate
    lag = max(0, round((latency - late) * sample_rate))
    timing = {
        "late": late,
        "offset": lag / sample_rate + late - latency,
        "gyro_shift": (late - delays[0]) * sample_rate,
        "force_shift": (late - delays[1]) * sample_rate,
        "gyro_lead": delays[0] * sample_rate,
        "force_lead": delays[1] * sample_rate,
    }
    return timing, lag
