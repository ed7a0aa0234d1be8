"""Numbers of the stand-in plant from its config."""

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant.config import PlantConfig
from quadjax.plant.effects import FlexParams, ImuParams, RotorParams
from quadjax.plant.gusts import gust_params
from quadjax.plant.plant import PlantParams
from quadjax.plant.power import PowerParams
from quadjax.vehicle.battery import battery_params
from quadjax.vehicle.constants import constant_names
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import Residual
from quadjax.vehicle.vehicle_file import VehicleFile, read_vehicle

AIR_DENSITY = 1.225  # kg/m^3
NOT_DRAWN = ("g", "rpm_min", "rpm_max")  # constants without deviation


def nominal_vehicle(config: PlantConfig) -> VehicleFile:
    """The drone of the training model.

    Raises:
        InputError: a vehicle file that cannot be read.
    """
    return read_vehicle(config.vehicle)


def build_plant(config: PlantConfig, residual: Residual | None = None) -> PlantParams:
    """The plant's numbers.

    Args:
        config: of the plant.
        residual: networks added to force and moment.

    Raises:
        InputError: a vehicle file that cannot be read.
    """
    base = nominal_vehicle(config)
    nominal = {name: float(getattr(base.motor, name)) for name in constant_names(MotorConstants)}
    factors, rotor_factors = drawn_factors(config)
    own = {name: value * factors.get(name, 1.0) for name, value in nominal.items()}
    constants = MotorConstants(**_traced(own))
    step = 1.0 / config.sample_rate
    gusts = config.gusts
    return PlantParams(
        vehicle=VehicleParams(constants, residual),
        rotor_factor=Rotors(*(jnp.float32(x) for x in rotor_factors)),
        rotors=_rotors(config, own["g"]),
        power=_power(config, nominal),
        flex=_flex(config),
        imu=_imu(config, nominal),
        gyroscopic=jnp.float32(config.effects.gyroscopic),
        gusts=gust_params(
            gusts.wind, gusts.altitude, gusts.least_airspeed, step, config.effects.gusts
        ),
        step=jnp.float32(step),
        command_delay=round(config.delay.command * config.sample_rate),
        measurement_delay=round(config.delay.measurement * config.sample_rate),
        substeps=config.substeps,
        integrator=config.integrator,
    )


def drawn_factors(config: PlantConfig) -> tuple[dict[str, float], np.ndarray]:
    """Factors on the drone's constants by name, and on the rotors' speeds (4,)."""
    random = np.random.default_rng(config.constants.seed)
    spread = config.constants.spread * config.effects.constants
    names = [name for name in constant_names(MotorConstants) if name not in NOT_DRAWN]
    factors = dict(zip(names, 1.0 + spread * random.uniform(-1.0, 1.0, len(names)), strict=True))
    unlike = config.motors.rotor_spread * config.effects.constants
    return factors, 1.0 + unlike * random.uniform(-1.0, 1.0, 4)


def _traced(values: dict[str, float]) -> dict[str, jax.Array]:
    return {name: jnp.asarray(value, jnp.float32) for name, value in values.items()}


def _rotors(config: PlantConfig, gravity: float) -> RotorParams:
    r, on = config.rotors, config.effects
    area = 4.0 * np.pi * r.radius**2
    # Momentum theory at hover: v_i = sqrt(T / (2 rho A)) (Leishman, 2006, equation 2.15).
    induced = np.sqrt(config.mass * gravity / (2.0 * AIR_DENSITY * area))
    numbers = {
        "mass": config.mass,
        "radius": r.radius,
        "height": r.height,
        "advance_loss": on.inflow * r.advance_loss,
        "ground": on.ground * r.ground_discs,
        "induced": induced,
        "flap": on.flapping,
        "flap_gain": r.flap_gain,
        "lock_number": r.lock_number,
        "hub_stiffness": r.hub_stiffness,
    }
    return RotorParams(**_traced(numbers))


def _power(config: PlantConfig, nominal: dict[str, float]) -> PowerParams:
    motors, on, hover = config.motors, config.effects, _hover_rpm(nominal)
    numbers = {
        "lag": on.motors * motors.lag,
        "shortfall": on.motors * motors.shortfall,
        "hover": hover,
    }
    battery = battery_params(config.battery, hover, on.battery)
    return PowerParams(**_traced(numbers), battery=battery)


def _flex(config: PlantConfig) -> FlexParams:
    f = config.flex
    numbers = {
        "frequency": 2.0 * np.pi * f.frequency,
        "damping": f.damping,
        "participation": config.effects.flex * f.participation,
    }
    return FlexParams(**_traced(numbers))


def _imu(config: PlantConfig, nominal: dict[str, float]) -> ImuParams:
    imu, on = config.imu, config.effects
    return ImuParams(
        offset=Vec3(*(jnp.float32(on.offset * x) for x in imu.offset)),
        vibration=jnp.float32(on.vibration * imu.vibration),
        turning=jnp.float32(on.vibration * imu.turning),
        hover=jnp.float32(_hover_rpm(nominal)),
    )


def _hover_rpm(nominal: dict[str, float]) -> float:
    return float(np.sqrt(nominal["g"] / (4.0 * nominal["k_w"])))
