"""Config of a plant: its physics, sensors and inner loop.

A section with numbers of the plant is also their traced form (``quadjax.core.traced``).
"assumed" in a description marks a number without a published value for a Bebop 1.
"""

from collections.abc import Sequence
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Literal, Self

from quadjax.core.errors import InputError, prefixed, short
from quadjax.core.section_keys import value_at, with_value
from quadjax.core.sections import (
    LARGEST,
    MAX_DRONES,
    MAX_SEED,
    ORDERED,
    Field,
    NonNegative,
    Positive,
    Section,
    load_section,
    model_validator,
)
from quadjax.core.traced import register
from quadjax.plant.sensor_config import SensorsConfig
from quadjax.vehicle.battery import BatteryConfig

Half = Annotated[float, Field(ge=0.0, le=0.5)]
Delay = Annotated[float, Field(ge=0.0, le=0.05)]
Lever = Annotated[float, Field(ge=-1.0, le=1.0)]
Number = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Terms = Annotated[dict[str, Number], Field(max_length=100)]
Numbers = Annotated[tuple[Number, ...], Field(max_length=MAX_DRONES)]
VARIABLES = ("w", "roll", "pitch", "yaw", "v", "vx", "vy", "vz", "p", "q", "r")  # of the airframe
OUTPUTS = ("force_z", "moment_x", "moment_y", "moment_z")

MAX_LATENCY = 60  # samples, of a motion capture pose


@register
class EffectsConfig(Section):
    """Strength of each effect that the training model lacks: 1 as in its section, 0 for none."""

    inflow: NonNegative = Field(1.0, description="thrust lost in a climb")
    ground: NonNegative = Field(1.0, description="thrust gained near the ground")
    flapping: NonNegative = Field(1.0, description="moments of blade flapping")
    motors: NonNegative = Field(1.0, description="second time constant of the motors")
    battery: NonNegative = Field(1.0, description="sag of the battery")
    gusts: NonNegative = Field(1.0, description="turbulence")
    constants: NonNegative = Field(1.0, description="deviation of the drone's constants")
    gyroscopic: NonNegative = Field(1.0, description="moments of the turning rotors")
    vibration: NonNegative = Field(1.0, description="rotor imbalance at the inertial unit")
    offset: NonNegative = Field(1.0, description="inertial unit off the center of gravity")
    airframe_force: NonNegative = Field(1.0, description="measured deviation of the force")
    airframe_moment: NonNegative = Field(1.0, description="measured deviation of the moment")


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

    tau: Positive | None = Field(
        None, description="s, first time constant; null: that of the vehicle"
    )
    lag: NonNegative = Field(0.008, description="s, second time constant; assumed")
    shortfall: NonNegative = Field(
        0.02, description="fraction of a commanded change from hover that is not reached; assumed"
    )
    slowing: Positive = Field(1.0, description="factor on the first time constant in slowing down")
    rotor_spread: Half = Field(0.01, description="largest relative deviation of one rotor's effect")
    rpm_max: Positive | None = Field(
        None, description="rpm, highest command; null: that of the vehicle"
    )


class AirframeConfig(Section):
    """Measured deviations of force and moment from the model: see ``quadjax.plant.airframe``."""

    force_z: Terms = Field(
        {}, description="m/s^2, specific force along body z: coefficient by term"
    )
    moment_x: Terms = Field({}, description="N m")
    moment_y: Terms = Field({}, description="N m")
    moment_z: Terms = Field({}, description="N m")
    limits: dict[str, Annotated[tuple[Number, Number], ORDERED]] = Field(
        {},
        max_length=100,
        description="of variables; beyond them one enters as at the limit",
    )

    @model_validator(mode="after")
    def _known(self) -> Self:
        allowed = f"allowed: 1, or one or two of {', '.join(VARIABLES)} with *"
        for output in OUTPUTS:
            for term in getattr(self, output):
                names = [] if term == "1" else term.split("*")
                if len(names) > 2 or set(names) - set(VARIABLES):
                    raise ValueError(f"airframe.{output} has the term {term!r}, {allowed}")
        for name in self.limits:
            if name not in VARIABLES:
                raise ValueError(f"airframe.limits has {name!r}, allowed: {', '.join(VARIABLES)}")
        return self


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
class IndiConfig(Section):
    """Inner loop from body rates and thrust to propeller speeds."""

    cutoff: Positive = Field(20.0, description="Hz, of the filter of every signal")
    roll_gain: NonNegative = Field(34.0, description="1/s, from rate error to angular acceleration")
    pitch_gain: NonNegative = Field(39.0, description="1/s; larger: pitch saturates earlier")
    yaw_gain: NonNegative = Field(33.0, description="1/s")
    moment_lag: Positive = Field(0.007, description="s, desired lag of roll and pitch acceleration")
    thrust_lag: Positive = Field(0.0305, description="s, desired lag of the thrust")


@register
class IndiSimpleConfig(Section):
    """Paparazzi's inner loop, ``stabilization_indi_simple``, as it flew the INDI policy."""

    cutoff: Positive = Field(8.0, description="Hz, of the filter of rates, thrust and commands")
    gain: Positive = Field(28.0, description="1/s, from rate error to angular acceleration")
    actuator_lag: Positive = Field(0.0185, description="s, of the loop's model of the actuators")
    effectiveness: tuple[Positive, Positive, Positive, NonNegative] | None = Field(
        None,
        description="rad/s^2 per unit of roll, pitch and yaw command, and of a change of the yaw "
        "command in a sample; null: of the vehicle's model in hover",
    )
    thrust_gain: Positive | None = Field(
        None, description="units per m/s^2 of thrust error; null: of the vehicle's model in hover"
    )
    yaw_rate: Positive = Field(2.09, description="rad/s, largest commanded yaw rate: 120 deg/s")
    saturation: Literal["clip"] | None = Field(
        None,
        description="where motors saturate; clip: each is limited by itself; null: roll and pitch "
        "have priority over thrust, thrust over yaw",
    )


class PlantConfig(Section):
    """A plant: a simulated drone, or a population of them."""

    name: str = Field("standin", pattern=r"^[\w-][\w.-]*$", description="folder of results")
    vehicle: str = Field("bebop1.yaml", description="the training model's file in configs/vehicles")
    fitted_vehicle: str | None = Field(
        None, description="vehicle file that airframe and population were fitted to; null: any"
    )
    mass: Positive | None = Field(
        None, description="kg, of the drone with its load; null: that of the vehicle file"
    )
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
    imu: ImuConfig = ImuConfig()
    battery: BatteryConfig = BatteryConfig()
    gusts: GustsConfig = GustsConfig()
    constants: ConstantsConfig = ConstantsConfig()
    delay: DelayConfig = DelayConfig()
    sensors: SensorsConfig = SensorsConfig()
    inner_loop: Literal["indi", "indi_simple"] = Field(
        "indi", description="of policies that command rates and thrust"
    )
    indi: IndiConfig = IndiConfig()
    indi_simple: IndiSimpleConfig = IndiSimpleConfig()
    population: dict[str, Numbers] = Field(
        {}, max_length=100, description="drones: of each dotted key its value for every drone"
    )
    drone: int = Field(
        0,
        ge=0,
        le=MAX_SEED,
        description="number of the first drone that flies, from 0; with a population, one of it",
    )

    @model_validator(mode="after")
    def _rates_agree(self) -> Self:
        rate, sensors = self.sample_rate, self.sensors
        half, longest = f"below half the sample_rate, {0.5 * rate:g} Hz", MAX_LATENCY / rate
        whole = f"sample_rate, {rate:g} Hz, divided by a whole number"
        late = f"0 to {longest:g} s ({MAX_LATENCY} samples)"
        for key, is_possible, allowed in (
            ("control_rate", rate % self.control_rate == 0, whole),
            ("indi.cutoff", self.indi.cutoff < 0.5 * rate, half),
            ("indi_simple.cutoff", self.indi_simple.cutoff < 0.5 * rate, half),
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

    @model_validator(mode="after")
    def _of_its_vehicle(self) -> Self:
        vehicle, fitted = self.vehicle, self.fitted_vehicle or self.vehicle
        if vehicle.removesuffix(".yaml") != fitted.removesuffix(".yaml"):
            raise ValueError(
                f"vehicle is {short(vehicle)}, but airframe and population of {self.name} are "
                f"fitted to {fitted}; for another drone use base: plant/standin"
            )
        return self

    @model_validator(mode="after")
    def _population(self) -> Self:
        if self.population and self.drone >= self.size:
            allowed = f"0 to {self.size - 1}, the drones of its population"
            raise ValueError(f"drone is {self.drone}, allowed: {allowed}")
        first = next(iter(self.population), "")
        for key, values in self.population.items():
            if len(values) != self.size:
                raise ValueError(
                    f"population.{key} has {len(values)} values, population.{first} "
                    f"{len(self.population[first])}; allowed: one for each drone, at least one"
                )
        for number in range(self.size if self.population else 0):
            self.member(number)
        return self

    @property
    def size(self) -> int:
        """Number of drones of the population; 1 without one."""
        return len(next(iter(self.population.values()), ())) or 1

    def member(self, number: int) -> Self:
        """One drone of the population, counted from ``drone`` on.

        After the last one they come again, with another seed of their constants. Without a
        population every drone has another seed.
        """
        number += self.drone
        seed = self.constants.seed + number // self.size
        own = with_value(self.replace(population={}, drone=0), "constants.seed", seed)
        for key, values in self.population.items():
            with prefixed(f"population.{key}"):
                value_at(self, key)  # or an error
            with prefixed(f"population.{key}, drone {number % self.size}"):
                own = with_value(own, key, values[number % self.size])
        return own


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
