"""Config of the stand-in plant: its physics, sensors and inner loop.

A section with numbers of the plant is also their traced form (``quadjax.core.traced``).
"assumed" in a description marks a number without a published value for a Bebop 1. Sensor defaults
are data-sheet values of the sensors in the flights of Ferede et al. (arXiv 2311.16948): the
MPU-6050 of a Bebop and an OptiTrack motion capture system.
"""

from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Literal, Self

from quadjax.core.errors import InputError
from quadjax.core.sections import (
    MAX_SEED,
    ORDERED,
    Field,
    Fraction,
    NonNegative,
    Positive,
    Section,
    load_section,
    model_validator,
)
from quadjax.core.traced import register
from quadjax.vehicle.battery import BatteryConfig

Half = Annotated[float, Field(ge=0.0, le=0.5)]
Delay = Annotated[float, Field(ge=0.0, le=0.05)]
Range = Annotated[tuple[Fraction, Fraction], ORDERED]  # a number is drawn between the two
Deviation = Annotated[float, Field(ge=-2.0, le=2.0)]
Deviations = Annotated[tuple[Deviation, Deviation], ORDERED]  # of either sign
Lever = Annotated[float, Field(ge=-1.0, le=1.0)]

MAX_LATENCY = 60  # samples, of a motion capture pose


@register
class EffectsConfig(Section):
    """Strength of each effect that the training model lacks: 1 as in its section, 0 for none."""

    inflow: NonNegative = Field(1.0, description="thrust lost in a climb")
    ground: NonNegative = Field(1.0, description="thrust gained near the ground")
    flapping: NonNegative = Field(1.0, description="moments of blade flapping")
    motors: NonNegative = Field(1.0, description="second time constant of the motors")
    flex: NonNegative = Field(1.0, description="vibration mode of the frame")
    battery: NonNegative = Field(1.0, description="sag of the battery")
    gusts: NonNegative = Field(1.0, description="turbulence")
    constants: NonNegative = Field(1.0, description="deviation of the drone's constants")
    gyroscopic: NonNegative = Field(1.0, description="moments of the turning rotors")
    vibration: NonNegative = Field(1.0, description="rotor imbalance at the inertial unit")
    offset: NonNegative = Field(1.0, description="inertial unit off the center of gravity")
    airframe: NonNegative = Field(1.0, description="deviations of rotors, wakes, axes and balance")


@register
class RotorConfig(Section):
    """Aerodynamics of the rotors."""

    radius: NonNegative = Field(
        0.0, description="m; 0: from the vehicle's thrust, with a thrust coefficient of 0.13"
    )
    height: NonNegative = Field(0.02, description="m above the center of gravity; assumed")
    advance_loss: NonNegative = Field(1.2, description="c of C_T = C_T0 (1 - c J^2)")
    flap_gain: NonNegative = Field(0.4, description="disc tilt per advance ratio")


@register
class MotorsConfig(Section):
    """Motors and their controllers."""

    lag: NonNegative = Field(0.008, description="s, second time constant; assumed")
    shortfall: NonNegative = Field(
        0.02, description="fraction of a commanded change from hover that is not reached; assumed"
    )
    rotor_spread: Half = Field(0.01, description="largest relative deviation of one rotor's effect")


class AirframeConfig(Section):
    """Ranges from which the airframe of each drone is drawn, by constants.seed; none by default."""

    speed_loss: Range = Field(
        (0.0, 0.0),
        description="fraction of a rotor's thrust that is lost per (w^2 - w_hover^2) / rpm_max^2",
    )
    torque_curve: Range = Field(
        (0.0, 0.0), description="fraction of a rotor's torque that is quadratic in its speed"
    )
    rotor_spread: Half = Field(0.0, description="largest deviation of one rotor's thrust")
    lift_loss: Deviations = Field(
        (0.0, 0.0), description="fraction of k_h that is missing in flight along body x"
    )
    side_lift_loss: Deviations = Field(
        (0.0, 0.0), description="fraction of k_h that is missing in flight along body y"
    )
    wake_loss: Range = Field(
        (0.0, 0.0), description="fraction of its thrust that a rotor loses behind the others"
    )
    tilt_deg: float = Field(0.0, ge=0.0, le=10.0, description="largest tilt of a rotor's axis")
    offset: tuple[Lever, Lever] = Field(
        (0.0, 0.0), description="m, largest distance of the center of gravity along x and y"
    )


@register
class FlexConfig(Section):
    """First vibration mode of the frame about each axis."""

    frequency: Positive = Field(32.0, description="Hz; assumed: the body sits on rubber dampers")
    damping: NonNegative = Field(0.06, description="fraction of critical; assumed")


@register
class ImuConfig(Section):
    """Place of the inertial unit and the vibration that reaches it; assumed."""

    offset: tuple[Lever, Lever, Lever] = Field(
        (0.01, 0.005, -0.01), description="m, body FRD, from the center of gravity; assumed"
    )
    vibration: NonNegative = Field(
        0.5, description="m/s^2, amplitude of one rotor at its hover speed; assumed"
    )


@register
class GustsConfig(Section):
    """Dryden turbulence near the ground."""

    wind: NonNegative = Field(
        2.0, description="m/s at 20 ft; 10% is the vertical deviation; assumed"
    )
    altitude: Positive = Field(3.05, description="m; the default is the model's lowest")


class ConstantsConfig(Section):
    """The drone's own constants, each drawn once around the training model's."""

    spread: Half = Field(0.04, description="largest relative deviation of a constant")
    seed: int = Field(1, ge=0, le=MAX_SEED, description="seed of the draw")


class DelayConfig(Section):
    """Transport delays, rounded to samples."""

    command: Delay = Field(0.004, description="s, from a command to the motor controllers")
    measurement: Delay = Field(0.002, description="s, from the motion to the sensors")


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


@register
class IndiConfig(Section):
    """Inner loop from body rates and thrust to propeller speeds."""

    cutoff: Positive = Field(20.0, description="Hz, of the filter of every signal")
    roll_gain: NonNegative = Field(34.0, description="1/s, from rate error to angular acceleration")
    pitch_gain: NonNegative = Field(39.0, description="1/s; larger: pitch saturates earlier")
    yaw_gain: NonNegative = Field(33.0, description="1/s")
    moment_lag: Positive = Field(0.007, description="s, desired lag of roll and pitch acceleration")
    thrust_lag: Positive = Field(0.0305, description="s, desired lag of the thrust")


class PlantConfig(Section):
    """The stand-in plant."""

    name: str = Field("standin", pattern=r"^[\w-][\w.-]*$", description="folder of results")
    vehicle: str = Field("bebop1.yaml", description="the training model's file in configs/vehicles")
    mass: Positive | None = Field(None, description="kg; null: that of the vehicle file")
    sample_rate: float = Field(
        500.0, ge=500, le=100_000, description="Hz, of physics, sensors, filters and inner loop"
    )
    control_rate: float = Field(
        500.0, gt=0, le=100_000, description="Hz, of the policy; divides sample_rate"
    )
    navigation: Literal["ekf", "ground_truth"] = Field("ekf", description="observed state")
    disturbance: Literal["ground_truth", "estimated", "none"] = Field(
        "estimated", description="observed external moment and force"
    )
    effects: EffectsConfig = EffectsConfig()
    rotors: RotorConfig = RotorConfig()
    motors: MotorsConfig = MotorsConfig()
    airframe: AirframeConfig = AirframeConfig()
    residual: str | None = Field(None, description="residual file, in addition to the effects")
    flex: FlexConfig = FlexConfig()
    imu: ImuConfig = ImuConfig()
    battery: BatteryConfig = BatteryConfig()
    gusts: GustsConfig = GustsConfig()
    constants: ConstantsConfig = ConstantsConfig()
    delay: DelayConfig = DelayConfig()
    sensors: SensorsConfig = SensorsConfig()
    indi: IndiConfig = IndiConfig()

    @model_validator(mode="after")
    def _rates_agree(self) -> Self:
        rate, sensors = self.sample_rate, self.sensors
        half, longest = f"below half the sample_rate, {0.5 * rate:g} Hz", MAX_LATENCY / rate
        whole = f"sample_rate, {rate:g} Hz, divided by a whole number"
        late = f"0 to {longest:g} s ({MAX_LATENCY} samples)"
        for key, is_possible, allowed in (
            ("control_rate", rate % self.control_rate == 0, whole),
            ("indi.cutoff", self.indi.cutoff < 0.5 * rate, half),
            ("sensors.gyro.low_pass", sensors.gyro.low_pass < 0.5 * rate, f"0 (none) or {half}"),
            (
                "sensors.accelerometer.low_pass",
                sensors.accelerometer.low_pass < 0.5 * rate,
                f"0 (none) or {half}",
            ),
            ("sensors.mocap.rate", sensors.mocap.rate <= rate, f"at most {rate:g} Hz"),
            ("sensors.mocap.latency", sensors.mocap.latency <= longest, late),
        ):
            if not is_possible:
                raise ValueError(f"{key} is {attrgetter(key)(self)}, allowed: {allowed}")
        return self


NO_EFFECTS = EffectsConfig(**dict.fromkeys(EffectsConfig.model_fields, 0.0))


def load_plant_config(path: Path | str, overrides: Sequence[str] = ()) -> PlantConfig:
    """The config of a YAML file, or of a name in ``configs/plant``, and ``key=value`` overrides.

    Raises:
        InputError: an unknown key, a wrong type, an impossible value or an unreadable file.
    """
    try:
        return load_section(PlantConfig, path, "plant", overrides)
    except InputError as error:
        if not str(error).startswith("overrides: "):
            raise
        raise InputError(f"{error} (overrides change the plant, not the race)") from None


def without_effects(config: PlantConfig) -> PlantConfig:
    """The same drone with every effect off, no residual and no delays: the training model."""
    delay = DelayConfig(command=0.0, measurement=0.0)
    return config.replace(effects=NO_EFFECTS, residual=None, delay=delay)
