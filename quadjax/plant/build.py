"""Numbers of the stand-in plant from its config."""

import jax.numpy as jnp
import numpy as np

from quadjax.core.traced import as_leaves
from quadjax.core.vectors import Rotors
from quadjax.plant.config import PlantConfig
from quadjax.plant.plant import PlantParams
from quadjax.vehicle.battery import battery_params
from quadjax.vehicle.constants import constant_names
from quadjax.vehicle.motor import MotorConstants, hover_rpm
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import Residual
from quadjax.vehicle.vehicle_file import VehicleFile, read_vehicle

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
    nominal = nominal_vehicle(config).motor
    factors, rotor_factors = drawn_factors(config)
    own = {name: jnp.float32(getattr(nominal, name) * factor) for name, factor in factors.items()}
    fixed = {name: jnp.float32(getattr(nominal, name)) for name in NOT_DRAWN}
    hover, effects, rate = hover_rpm(nominal), config.effects, config.sample_rate
    return PlantParams(
        vehicle=VehicleParams(MotorConstants(**own, **fixed), residual),
        rotor_factor=Rotors(*(jnp.float32(x) for x in rotor_factors)),
        effects=as_leaves(effects),
        rotors=as_leaves(config.rotors),
        motors=as_leaves(config.motors),
        flex=as_leaves(config.flex),
        imu=as_leaves(config.imu),
        gusts=as_leaves(config.gusts),
        battery=battery_params(config.battery, hover, effects.battery),
        mass=jnp.float32(config.mass),
        hover=jnp.float32(hover),
        step=jnp.float32(1.0 / rate),
        command_delay=round(config.delay.command * rate),
        measurement_delay=round(config.delay.measurement * rate),
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
