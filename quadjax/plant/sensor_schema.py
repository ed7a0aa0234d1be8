"""The schema of the ``sensors`` and ``ekf`` sections: every error of every sensor, zero for none.

Defaults are data-sheet values of the kinds of sensor in the flights of Ferede et al. (arXiv
2311.16948): a Bebop's MPU-6050 and an OptiTrack motion capture system. Where no data sheet
gives a number the comment says "assumed".
"""

import dataclasses
import math
from dataclasses import dataclass, field

from quadjax.core.errors import InputError


@dataclass(frozen=True)
class GyroConfig:
    """Gyroscope. InvenSense MPU-6000/6050 product specification, PS-MPU-6000A-00."""

    noise: float = 8.7e-5  # rad/s/sqrt(Hz), one-sided density: 0.005 deg/s/sqrt(Hz)
    bias: float = 0.005  # rad/s at the start, standard deviation; assumed: zeroed on the ground
    bias_walk: float = 1.94e-5  # rad/s/sqrt(s); Burri et al., IJRR 35(10), 2016, a MEMS IMU
    low_pass: float = 98.0  # Hz, of the unit's own filter (its setting 2); 0: none


@dataclass(frozen=True)
class AccelerometerConfig:
    """Accelerometer of the same unit."""

    noise: float = 3.9e-3  # m/s^2/sqrt(Hz), one-sided density: 400 ug/sqrt(Hz)
    bias: float = 0.1  # m/s^2 at the start, standard deviation; assumed: 10 mg after calibration
    bias_walk: float = 3.0e-3  # m/s^2/sqrt(s); Burri et al., 2016
    low_pass: float = 94.0  # Hz; 0: none


@dataclass(frozen=True)
class RpmConfig:
    """Propeller speeds as the motor controllers report them."""

    noise: float = 20.0  # rpm, standard deviation; assumed: 0.3% of hover
    resolution: float = 1.0  # rpm, the unit in which a Bebop's motor controller reports; 0: exact


@dataclass(frozen=True)
class MocapConfig:
    """Motion capture of a rigid body's pose. OptiTrack Prime 13 data sheet, Flex 13 rates."""

    rate: float = 200.0  # Hz, frames
    latency: float = 0.02  # s from exposure to arrival on board; assumed: 4 ms camera, then Wi-Fi
    position_noise: float = 1.0e-3  # m; the data sheet's 0.2 mm and the body's calibration
    attitude_noise: float = 8.7e-3  # rad about each axis: 0.5 deg
    dropout: float = 0.02  # fraction of frames lost; assumed
    dropout_frames: float = 3.0  # mean number of frames lost in a row; assumed


@dataclass(frozen=True)
class SensorsConfig:
    """All sensors."""

    gyro: GyroConfig = field(default_factory=GyroConfig)
    accelerometer: AccelerometerConfig = field(default_factory=AccelerometerConfig)
    rpm: RpmConfig = field(default_factory=RpmConfig)
    mocap: MocapConfig = field(default_factory=MocapConfig)


@dataclass(frozen=True)
class EkfConfig:
    """What the navigation filter assumes beyond the sensors' own noise, which it knows."""

    gyro_noise: float = 2.0e-4  # rad/s/sqrt(Hz) at 500 samples/s, for what lies between them
    accelerometer_noise: float = 6.0e-3  # m/s^2/sqrt(Hz), likewise
    gyro_bias_walk: float = 1.0e-5  # rad/s/sqrt(s), floor of the assumed walk
    accelerometer_bias_walk: float = 1.0e-3  # m/s^2/sqrt(s)
    position_noise: float = 1.0e-4  # m, floor of the assumed error of a pose
    attitude_noise: float = 1.0e-4  # rad
    start_position: float = 3.0e-3  # m, standard deviation of the first estimate, added to a pose's
    start_velocity: float = 0.5  # m/s; the first estimate is zero
    start_attitude: float = 5.0e-3  # rad, added to a pose's
    start_gyro_bias: float = 1.0e-3  # rad/s, floor; the first estimate is zero
    start_accelerometer_bias: float = 1.0e-2  # m/s^2


@dataclass(frozen=True)
class NavigationConfig:
    """The sections by their names in a config."""

    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    ekf: EkfConfig = field(default_factory=EkfConfig)


NO_ERRORS = SensorsConfig(
    GyroConfig(0.0, 0.0, 0.0, 0.0),
    AccelerometerConfig(0.0, 0.0, 0.0, 0.0),
    RpmConfig(0.0, 0.0),
    MocapConfig(latency=0.0, position_noise=0.0, attitude_noise=0.0, dropout=0.0),
)
MOST_DELAY_STEPS = 60  # samples that a pose may be late


def check_sensors(config: SensorsConfig, sample_rate: float, prefix: str = "sensors") -> None:
    """Raise an ``InputError`` that names the key, the value and what is allowed.

    Args:
        config: the section.
        sample_rate: of the sensors and of the filter, Hz.
        prefix: what the section is called in the config.
    """
    for section in ("gyro", "accelerometer", "rpm", "mocap"):
        own = getattr(config, section)
        _not_negative(own, f"{prefix}.{section}")
        low_pass = getattr(own, "low_pass", 0.0)
        if low_pass >= 0.5 * sample_rate:
            raise InputError(
                f"{prefix}.{section}.low_pass is {low_pass}, allowed: 0 (none), or less than half "
                f"the sample rate {sample_rate:g} Hz"
            )
    mocap, most = config.mocap, MOST_DELAY_STEPS / sample_rate
    for key, fine, allowed in (
        ("rate", 0.0 < mocap.rate <= sample_rate, f"above 0, at most the {sample_rate:g} Hz"),
        ("latency", mocap.latency <= most, f"0 to {most:g} s ({MOST_DELAY_STEPS} samples)"),
        ("dropout", mocap.dropout <= 0.9, "0.0 to 0.9"),
        (
            "dropout_frames",
            mocap.dropout_frames >= 1.0 / (1.0 - min(mocap.dropout, 0.9)),
            f"at least 1 / (1 - dropout), {1.0 / (1.0 - min(mocap.dropout, 0.9)):.3g}",
        ),
    ):
        if not fine:
            raise InputError(f"{prefix}.mocap.{key} is {getattr(mocap, key)!r}, allowed: {allowed}")


def check_ekf(config: EkfConfig, prefix: str = "ekf") -> None:
    """Raise an ``InputError`` for a number that is negative, or zero where that makes no filter."""
    _not_negative(config, prefix)
    for key in ("position_noise", "attitude_noise"):
        if getattr(config, key) == 0.0:
            raise InputError(f"{prefix}.{key} is 0.0, allowed: a positive number")


def _not_negative(section: object, name: str) -> None:
    for item in dataclasses.fields(section):
        value = getattr(section, item.name)
        if not (math.isfinite(value) and value >= 0.0):
            raise InputError(f"{name}.{item.name} is {value!r}, allowed: a number, not negative")
