"""Numbers of the navigation filter, worked out from what it knows of the sensors."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from scipy.signal import lfilter

from quadjax.plant.sensor_schema import EkfConfig, SensorsConfig, check_ekf, check_sensors
from quadjax.plant.sensors import low_pass, low_pass_delay

UNREST_SECONDS = 0.05  # over which second differences are averaged
REFERENCE_RATE = 500.0  # Hz, at which the config's noise between two samples is meant


@struct.dataclass
class EkfParams:
    """The filter of one set of sensors; traced, but for how many samples it runs behind."""

    step: jax.Array  # s between samples
    gravity: jax.Array  # m/s^2
    gyro_density: jax.Array  # variance of the attitude per second, rad^2/s
    force_density: jax.Array  # of the velocity, (m/s)^2/s
    gyro_walk: jax.Array  # of the gyro bias, (rad/s)^2/s
    force_walk: jax.Array  # of the accelerometer bias, (m/s^2)^2/s
    position_variance: jax.Array  # of a pose, m^2
    attitude_variance: jax.Array  # rad^2
    start: tuple[jax.Array, ...]  # (5) standard deviations of the first estimate
    late: jax.Array  # s, by which inertial samples are late
    offset: jax.Array  # s, of a pose after the delayed estimate
    gyro_shift: jax.Array  # part of a step by which the gyro is held back to be as late
    force_shift: jax.Array  # likewise the accelerometer
    gyro_lead: jax.Array  # steps by which the gyro is carried on to the present
    force_lead: jax.Array  # likewise the accelerometer
    gyro_variance: jax.Array  # noise of the gyro carried on to the present, (rad/s)^2
    force_variance: jax.Array  # (m/s^2)^2
    unrest_rate: jax.Array  # share of a new second difference in their mean
    lag: int = struct.field(pytree_node=False, default=0)  # samples that wait


def ekf_params(
    sensors: SensorsConfig, config: EkfConfig, sample_rate: float, gravity: float = 9.81
) -> EkfParams:
    """The filter for a config's sensors, whose noise, delays and low-passes it knows.

    Between two samples a step ``T`` long the trapezoidal rule misses ``T^3 / 12`` of the signal's
    second derivative. As white noise that is a density which grows with ``T^2.5``.

    Args:
        sensors: the ``sensors`` section.
        config: the ``ekf`` section.
        sample_rate: Hz.
        gravity: m/s^2.

    Raises:
        InputError: a value that cannot be.
    """
    check_sensors(sensors, sample_rate)
    check_ekf(config)
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
        "gyro_variance": _carried_on(gyro.noise, gyro.low_pass, sample_rate),
        "force_variance": _carried_on(force.noise, force.low_pass, sample_rate),
        "unrest_rate": min(1.0, 1.0 / (sample_rate * UNREST_SECONDS)),
    }
    return EkfParams(
        **{name: jnp.asarray(value, jnp.float32) for name, value in (numbers | timing).items()},
        start=tuple(jnp.asarray(value, jnp.float32) for value in start),
        lag=lag,
    )


def _timing(sensors: SensorsConfig, sample_rate: float) -> tuple[dict[str, float], int]:
    """How late everything is, and how many samples the filter runs behind."""
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

    The first pose is of the present, the first inertial sample of ``late`` seconds ago, and how far
    the drone went in between is as unknown as its velocity.
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
    """Variance per second of the integral of white noise, of its one-sided density."""
    return 0.5 * (noise**2 + extra**2)


def _carried_on(noise: float, cutoff: float, sample_rate: float) -> float:
    """Variance of a filtered sample that is carried on by its delay along its last difference."""
    forward, feedback = low_pass(cutoff, sample_rate)
    impulse = np.zeros(4096)
    impulse[0] = 1.0
    response = lfilter(forward, np.concatenate([[1.0], feedback]), impulse)
    steps = low_pass_delay(cutoff, sample_rate) * sample_rate
    response = response + steps * np.diff(response, prepend=0.0)
    return 0.5 * noise**2 * sample_rate * float((response**2).sum())
