"""The schema of ``configs/plant/*.yaml``: the stand-in plant, what it carries and how it is flown.

Numbers that have no published value for a Bebop 1 are marked "assumed".
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from quadjax.config.checks import value_at
from quadjax.config.loading import fill, merge_trees, parse_words, read_yaml_with_base
from quadjax.core.errors import InputError
from quadjax.core.integrators import INTEGRATORS
from quadjax.plant.sensor_schema import EkfConfig, SensorsConfig, check_ekf, check_sensors


@dataclass(frozen=True)
class EffectsConfig:
    """How strongly each effect is there: 1 as its section says, 0 not at all."""

    inflow: float = 1.0
    ground: float = 1.0
    flapping: float = 1.0
    motors: float = 1.0
    flex: float = 1.0
    battery: float = 1.0
    gusts: float = 1.0
    constants: float = 1.0


@dataclass(frozen=True)
class RotorConfig:
    """Rotors in the air."""

    radius: float = 0.07  # m
    height: float = 0.02  # m above the centre of gravity; assumed
    advance_loss: float = 1.2  # c of C_T = C_T0 (1 - c J^2) beyond the linear part
    ground_discs: float = 4.0  # rotors that act on the ground as one disc of their area
    flap_gain: float = 0.4  # backward tilt of the disc per advance ratio
    lock_number: float = 3.0  # aerodynamic over inertial moment of a blade; assumed
    hub_stiffness: float = 0.03  # N m/rad of all hubs; assumed


@dataclass(frozen=True)
class MotorsConfig:
    """Motors and their controllers."""

    lag: float = 0.008  # s, the second time constant; assumed
    shortfall: float = 0.02  # of a commanded change from hover that is never reached; assumed
    rotor_spread: float = 0.01  # by which one rotor's speed counts more or less than another's


@dataclass(frozen=True)
class FlexConfig:
    """The frame's first mode about each axis."""

    frequency: float = 32.0  # Hz; assumed: the Bebop's body sits on rubber dampers
    damping: float = 0.06  # of critical; assumed
    participation: float = 0.15  # share of the angular acceleration that drives it; assumed


@dataclass(frozen=True)
class BatteryConfig:
    """A lithium-polymer battery of three cells, 1200 mAh (Bebop 1)."""

    voltage: float = 12.6  # V, open circuit, full
    drop: float = 1.5  # V by which the open circuit's falls until it is empty
    resistance: float = 0.07  # ohm, with leads and controllers; assumed
    hover_current: float = 6.5  # A: 11 minutes of hover
    capacity: float = 1.2  # Ah
    charge: list[float] = field(default_factory=lambda: [0.6, 1.0])  # at a start, lowest, highest
    rpm_full: float = 12000.0  # rpm that are reached at the full voltage


@dataclass(frozen=True)
class GustsConfig:
    """Dryden turbulence near the ground."""

    wind: float = 2.0  # m/s at 20 ft, of which a tenth is the vertical gusts' deviation; assumed
    altitude: float = 3.05  # m: the model's lowest
    least_airspeed: float = 1.0  # m/s, at which gusts pass a drone that stands still


@dataclass(frozen=True)
class ConstantsConfig:
    """The drone's own constants: each drawn once, within a fraction of the training model's."""

    spread: float = 0.04
    seed: int = 1


@dataclass(frozen=True)
class DelayConfig:
    """Transport delays, in whole control steps of the sample rate."""

    command: float = 0.004  # s from a command to the motors' controllers
    measurement: float = 0.002  # s from what is true to what the sensors see


@dataclass(frozen=True)
class IndiConfig:
    """The inner loop from rates and thrust to rpm."""

    cutoff: float = 20.0  # Hz of the filter that every signal shares
    roll_gain: float = 34.0  # 1/s from rate error to angular acceleration
    pitch_gain: float = 39.0  # 1/s; larger, because pitch saturates the motors earlier
    yaw_gain: float = 33.0  # 1/s
    moment_lag: float = 0.007  # s, wanted of the roll and pitch acceleration
    thrust_lag: float = 0.0305  # s, wanted of the thrust
    least_rpm: float = 2000.0  # below which the effectiveness is taken as there


@dataclass(frozen=True)
class PlantConfig:
    """The stand-in plant."""

    name: str = "standin"
    vehicle: str = "bebop1.yaml"  # in configs/vehicles: what the training model takes it for
    sample_rate: float = 500.0  # Hz of sensors, filters and inner loop
    control_rate: float = 500.0  # Hz of the policy: 100, 250 or 500
    substeps: int = 1  # physics steps in a sample
    integrator: str = "rk4"  # euler | rk4
    navigation: str = "ekf"  # ekf | truth: what the policy sees; truth for development only
    disturbance_input: str = "estimated"  # true | estimated | none
    effects: EffectsConfig = field(default_factory=EffectsConfig)
    rotors: RotorConfig = field(default_factory=RotorConfig)
    motors: MotorsConfig = field(default_factory=MotorsConfig)
    flex: FlexConfig = field(default_factory=FlexConfig)
    battery: BatteryConfig = field(default_factory=BatteryConfig)
    gusts: GustsConfig = field(default_factory=GustsConfig)
    constants: ConstantsConfig = field(default_factory=ConstantsConfig)
    delay: DelayConfig = field(default_factory=DelayConfig)
    sensors: SensorsConfig = field(default_factory=SensorsConfig)
    ekf: EkfConfig = field(default_factory=EkfConfig)
    indi: IndiConfig = field(default_factory=IndiConfig)


NO_EFFECTS = EffectsConfig(**{item.name: 0.0 for item in dataclasses.fields(EffectsConfig)})
CONTROL_RATES = (100.0, 250.0, 500.0)
MOST_DELAY = 0.05  # s
LEAST_PHYSICS_RATE = 500.0  # Hz
Check = tuple[str, bool, str]  # key, whether it is fine, what is allowed


def load_plant_config(path: Path | str, words: Sequence[str] = ()) -> PlantConfig:
    """The config of a YAML file and ``key=value`` words, complete and checked.

    Raises:
        InputError: an unknown key, a wrong type, an impossible value or an unreadable file.
    """
    tree = merge_trees(read_yaml_with_base(path), parse_words(words))
    config = fill(PlantConfig, tree, str(path))
    check_plant(config)
    return config


def check_plant(config: PlantConfig) -> None:
    """Raise an ``InputError`` that names the key, the value and what is allowed."""
    _check_sections(config)
    for key, fine, allowed in (*_timing(config), *_choices(config), *_limits(config)):
        if not fine:
            raise InputError(f"{key} is {value_at(config, key)!r}, allowed: {allowed}")
    check_sensors(config.sensors, config.sample_rate)
    check_ekf(config.ekf)


def _timing(config: PlantConfig) -> list[Check]:
    rate, control = config.sample_rate, config.control_rate
    ratio = rate / control if control > 0 else 0.0
    physics = f"physics at {LEAST_PHYSICS_RATE:g} Hz or faster (sample_rate times substeps)"
    return [
        ("control_rate", control in CONTROL_RATES, "100, 250, 500"),
        ("sample_rate", ratio >= 1 and ratio == int(ratio), "a multiple of control_rate"),
        ("substeps", 1 <= config.substeps <= 100, "1 to 100"),
        ("substeps", rate * config.substeps >= LEAST_PHYSICS_RATE, physics),
        ("delay.command", config.delay.command <= MOST_DELAY, _TO_MOST),
        ("delay.measurement", config.delay.measurement <= MOST_DELAY, _TO_MOST),
        ("indi.cutoff", config.indi.cutoff < 0.5 * rate, "below half the sample_rate"),
    ]


def _choices(config: PlantConfig) -> list[Check]:
    allowed = {
        "integrator": tuple(INTEGRATORS),
        "navigation": NAVIGATION,
        "disturbance_input": DISTURBANCE_INPUTS,
    }
    return [(key, getattr(config, key) in of, ", ".join(of)) for key, of in allowed.items()]


def _limits(config: PlantConfig) -> list[Check]:
    name, charge = config.name, config.battery.charge
    fine = bool(name) and name[0] != "." and all(c.isalnum() or c in "._-" for c in name)
    ordered = len(charge) == 2 and 0 <= charge[0] <= charge[1] <= 1
    return [
        ("name", fine, "letters, digits, . _ -"),
        ("battery.charge", ordered, "[lowest, highest], 0 to 1"),
        ("constants.spread", config.constants.spread <= 0.5, "0 to 0.5"),
    ]


NAVIGATION = ("ekf", "truth")
DISTURBANCE_INPUTS = ("true", "estimated", "none")
_TO_MOST = f"0 to {MOST_DELAY} s"
_POSITIVE = (
    "rotors.radius",
    "rotors.lock_number",
    "flex.frequency",
    "battery.voltage",
    "battery.capacity",
    "battery.rpm_full",
    "gusts.altitude",
    "gusts.least_airspeed",
    "indi.cutoff",
    "indi.moment_lag",
    "indi.thrust_lag",
    "indi.least_rpm",
)


def _check_sections(config: PlantConfig) -> None:
    """Every number of the plant's own sections is finite and not negative; some are positive."""
    for section in dataclasses.fields(config):
        own = getattr(config, section.name)
        if not dataclasses.is_dataclass(own) or section.name in ("sensors", "ekf"):
            continue
        for item in dataclasses.fields(own):
            value, key = getattr(own, item.name), f"{section.name}.{item.name}"
            numbers = value if isinstance(value, list) else [value]
            if not all(math.isfinite(x) and x >= 0 for x in numbers):
                raise InputError(f"{key} is {value!r}, allowed: finite numbers, not negative")
            if key in _POSITIVE and value <= 0:
                raise InputError(f"{key} is {value!r}, allowed: a positive number")
