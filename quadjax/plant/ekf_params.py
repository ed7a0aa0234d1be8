"""Parameters of the navigation filter, derived from those of the sensors."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from scipy.signal import lfilter

from quadjax.plant.config import EkfConfig, SensorsConfig
from quadjax.plant.covariance import Growth
from quadjax.plant.sensors import low_pass, low_pass_delay

ROUGHNESS_SECONDS = 0.05  # averaging time of squared second differences
REFERENCE_RATE = 500.0  # Hz, at which the config gives the noise between two samples


@struct.dataclass
class EkfParams:
    """Parameters of the filter; traced, except for its lag in samples."""

    step: jax.Array  # s between samples
    gravity: jax.Array  # m/s^2
    gyro_density: jax.Array  # variance of the attitude per second, rad^2/s
    force_density: jax.Array  # of the velocity, (m/s)^2/s
    gyro_walk: jax.Array  # of the gyro bias, (rad/s)^2/s
    force_walk: jax.Array  # of the accelerometer bias, (m/s^2)^2/s
    position_variance: jax.Array  # of a pose, m^2
    attitude_variance: jax.Array  # rad^2
    start: tuple[jax.Array, ...]  # (5) standard deviations of the first estimate
    late: jax.Array  # s, delay of inertial samples
    offset: jax.Array  # s, from the delayed estimate to a pose
    gyro_shift: jax.Array  # fraction of a step by which the gyro is delayed to align it
    force_shift: jax.Array  # the same of the accelerometer
    gyro_lead: jax.Array  # steps by which the gyro is extrapolated to the present
    force_lead: jax.Array  # the same of the accelerometer
    gyro_variance: jax.Array  # noise of the extrapolated gyro, (rad/s)^2
    force_variance: jax.Array  # (m/s^2)^2
    roughness_rate: jax.Array  # weight of a new second difference in the mean
    lag: int = struct.field(pytree_node=False, default=0)  # samples in the buffer

    def growth(self, time: jax.Array) -> Growth:
        """Variances that the sensors' noise adds over ``time``, s."""
        densities = (self.force_density, self.gyro_density, self.gyro_walk, self.force_walk)
        return Growth(*(density * time for density in densities))


def ekf_params(
    sensors: SensorsConfig, config: EkfConfig, sample_rate: float, gravity: float = 9.81
) -> EkfParams:
    """The filter for the sensors of a config.

    Between two samples a step ``T`` apart the trapezoidal rule has an error of ``T^3 / 12`` times
    the signal's second derivative; as white noise its density grows with ``T^2.5``.

    Args:
        sensors: the ``sensors`` section.
        config: the ``ekf`` section.
        sample_rate: Hz.
        gravity: m/s^2.
    """
    gyro, force = sensors.gyro, sensors.accelerometer
    between = (REFERENCE_RATE / sample_rate) ** 2.5
    timing, lag = _timing(sensors, sample_rate)
    position, attitude, *start = _first_estimate(sensors, config, timing["late"])
    numbers = {
        "step": 1.0 / sample_rate,
        "gravity": gravity,
        "gyro_density": _density(gyro.noise, between * config.gyro_noise),
        "force_density": _density(force.noise, between * config.accelerometer_noise),
        "gyro_walk": gyro.bias_walk**2 + config.gyro_bias_walk**2,
        "force_walk": force.bias_walk**2 + config.accelerometer_bias_walk**2,
        "position_variance": position**2,
        "attitude_variance": attitude**2,
        "gyro_variance": _extrapolated(gyro.noise, gyro.low_pass, sample_rate),
        "force_variance": _extrapolated(force.noise, force.low_pass, sample_rate),
        "roughness_rate": min(1.0, 1.0 / (sample_rate * ROUGHNESS_SECONDS)),
    }
    return EkfParams(
        **{name: jnp.asarray(value, jnp.float32) for name, value in (numbers | timing).items()},
        start=tuple(jnp.asarray(value, jnp.float32) for value in start),
        lag=lag,
    )


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


def _first_estimate(sensors: SensorsConfig, config: EkfConfig, late: float) -> tuple[float, ...]:
    """Standard deviations of a pose's position and attitude, then of the first estimate (5).

    The first pose has no delay and the first inertial sample has ``late`` seconds; the distance
    flown in between is as uncertain as the velocity.
    """
    position = math.hypot(sensors.mocap.position_noise, config.position_noise)
    attitude = math.hypot(sensors.mocap.attitude_noise, config.attitude_noise)
    return (
        position,
        attitude,
        math.hypot(position, config.start_position, late * config.start_velocity),
        config.start_velocity,
        math.hypot(attitude, config.start_attitude),
        math.hypot(sensors.gyro.bias, config.start_gyro_bias),
        math.hypot(sensors.accelerometer.bias, config.start_accelerometer_bias),
    )


def _density(noise: float, extra: float) -> float:
    """Variance per second of integrated white noise, from its one-sided density."""
    return 0.5 * (noise**2 + extra**2)


def _extrapolated(noise: float, cutoff: float, sample_rate: float) -> float:
    """Noise variance of a filtered sample extrapolated by its delay along the last difference."""
    forward, feedback = low_pass(cutoff, sample_rate)
    impulse = np.zeros(4096)
    impulse[0] = 1.0
    response = lfilter(forward, np.concatenate([[1.0], feedback]), impulse)
    steps = low_pass_delay(cutoff, sample_rate) * sample_rate
    response = response + steps * np.diff(response, prepend=0.0)
    return 0.5 * noise**2 * sample_rate * float((response**2).sum())
