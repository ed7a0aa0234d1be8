"""Config of the plant's sensors.

Defaults are data-sheet values of the sensors in the flights of Ferede et al. (arXiv 2311.16948):
the MPU-6050 of a Bebop and an OptiTrack motion capture system. "assumed" marks a number without a
published value.
"""

from typing import Self

from quadjax.core.sections import Field, NonNegative, Positive, Section, model_validator
from quadjax.core.traced import register


@register
class GyroConfig(Section):
    """Gyroscope. InvenSense MPU-6000/6050 product specification, PS-MPU-6000A-00."""

    noise: NonNegative = Field(
        8.7e-5, description="rad/s/sqrt(Hz), one-sided: 0.005 deg/s/sqrt(Hz)"
    )
    bias: NonNegative = Field(0.005, description="rad/s at the start, standard deviation; assumed")
    bias_walk: NonNegative = Field(1.94e-5, description="rad/s/sqrt(s); Burri et al., IJRR 2016")
    low_pass: NonNegative = Field(
        98.0, description="Hz, of the unit's filter (setting 2); 0 for none"
    )


@register
class AccelerometerConfig(Section):
    """Accelerometer of the same unit."""

    noise: NonNegative = Field(3.9e-3, description="m/s^2/sqrt(Hz), one-sided: 400 ug/sqrt(Hz)")
    bias: NonNegative = Field(0.1, description="m/s^2 at the start, standard deviation; assumed")
    bias_walk: NonNegative = Field(3.0e-3, description="m/s^2/sqrt(s); Burri et al., IJRR 2016")
    low_pass: NonNegative = Field(94.0, description="Hz; 0 for none")


@register
class RpmConfig(Section):
    """Propeller speeds as the motor controllers report them."""

    noise: NonNegative = Field(20.0, description="rpm, standard deviation; assumed: 0.3% of hover")
    resolution: NonNegative = Field(1.0, description="rpm; 0 for exact")


@register
class MocapConfig(Section):
    """Motion capture of a rigid body's pose. OptiTrack Prime 13 data sheet, Flex 13 rates."""

    rate: Positive = Field(200.0, description="Hz; at most sample_rate")
    latency: NonNegative = Field(
        0.02, description="s, exposure to arrival; assumed: 4 ms, then Wi-Fi"
    )
    position_noise: NonNegative = Field(1.0e-3, description="m: data sheet, body calibration")
    attitude_noise: NonNegative = Field(8.7e-3, description="rad about each axis: 0.5 deg")
    dropout: float = Field(0.02, ge=0.0, le=0.9, description="fraction of lost frames; assumed")
    dropout_frames: float = Field(
        3.0, ge=0, le=1000, description="mean number of consecutive lost frames; assumed"
    )

    @model_validator(mode="after")
    def _possible(self) -> Self:
        shortest = 1.0 / (1.0 - self.dropout)
        if self.dropout_frames < shortest:
            raise ValueError(
                f"sensors.mocap.dropout_frames is {self.dropout_frames}, allowed: at least "
                f"{shortest:.3g}, 1 / (1 - dropout)"
            )
        return self


class SensorsConfig(Section):
    """All sensors. A number of zero turns its error off."""

    gyro: GyroConfig = GyroConfig()
    accelerometer: AccelerometerConfig = AccelerometerConfig()
    rpm: RpmConfig = RpmConfig()
    mocap: MocapConfig = MocapConfig()
