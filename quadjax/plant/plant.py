"""The plant: the motor-level drone with effects that the training model lacks.

Functions are of one drone; batch with ``vmap``. Each effect is multiplied by its strength: with all
of them zero the derivative is that of ``quadjax.vehicle.motor``.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.core.frames import attitude, body_to_world, euler_rates, world_to_body, wrap_angle
from quadjax.core.integrators import rk4_step
from quadjax.core.materialize import materialized
from quadjax.core.resources import CONFIGS
from quadjax.core.traced import as_leaves
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import effects, gusts
from quadjax.plant.airframe import AirframeDeviations, airframe_force_moment, make_airframe
from quadjax.plant.config import (
    EffectsConfig,
    GustsConfig,
    ImuConfig,
    MotorsConfig,
    PlantConfig,
    RotorConfig,
)
from quadjax.plant.gusts import GustState
from quadjax.plant.sensors import GroundTruth
from quadjax.vehicle import motor
from quadjax.vehicle.airframe import RPM_PER_RAD_S
from quadjax.vehicle.battery import BatteryParams, battery_params, charge_rate, highest_rpm
from quadjax.vehicle.constants import constant_names
from quadjax.vehicle.motor import MotorConstants, hover_rpm
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import read_residual
from quadjax.vehicle.rigid_body import BodyState, RigidBodyState
from quadjax.vehicle.vehicle_file import VehicleFile, read_vehicle

NOT_DRAWN = ("g", "rpm_min", "rpm_max")  # constants without deviation
BEBOP, BEBOP_RADIUS_M = CONFIGS / "vehicles" / "bebop1.yaml", 0.07


class PlantParams(struct.PyTreeNode):
    """Numbers of the plant; traced, except for the static fields."""

    vehicle: VehicleParams  # the drone's own constants
    rotor_factor: Rotors  # on each rotor's speed in force and moment
    effects: EffectsConfig  # their strengths
    airframe: AirframeDeviations | None  # its measured deviations; None: as the model
    rotors: RotorConfig
    motors: MotorsConfig
    imu: ImuConfig
    gusts: GustsConfig
    battery: BatteryParams
    mass: jax.Array  # kg
    lightness: jax.Array  # () mass of the vehicle file over that of the drone
    hover: jax.Array  # rpm, of the training model
    step: jax.Array  # s, of one sample
    command_delay: jax.Array  # () samples, at most commands_waiting
    commands_waiting: int = struct.field(pytree_node=False, default=0)
    measurement_delay: int = struct.field(pytree_node=False, default=0)  # samples


class Physics(struct.PyTreeNode):
    """The integrated state."""

    body: RigidBodyState
    rpm_rate: Rotors  # rpm/s, of second-order motors
    charge: jax.Array  # () left in the battery, 0 to 1


class PlantState(struct.PyTreeNode):
    """One drone."""

    physics: Physics
    turning: Vec3  # mean angular acceleration of the last sample, rad/s^2, body
    phase: Rotors  # angles of the rotors, rad
    gusts: GustState
    commands: tuple[Rotors, ...]  # on their way to the motors, rpm, the oldest first


def nominal_vehicle(config: PlantConfig) -> VehicleFile:
    """The drone of the training model.

    Raises:
        InputError: a vehicle file that cannot be read.
    """
    return read_vehicle(config.vehicle)


def filled(config: PlantConfig) -> PlantConfig:
    """The config with mass, propeller radius and highest speed from its vehicle, if not set.

    The radius follows from the vehicle's thrust and the Bebop 1's thrust coefficient, 0.13.

    Raises:
        InputError: a vehicle file that cannot be read, or that has no mass.
    """
    vehicle, bebop = nominal_vehicle(config), read_vehicle(str(BEBOP))
    mass = config.mass or vehicle.mass
    if mass is None:
        raise InputError(f"{vehicle.path}: mass is missing; the plant needs it, in kg")
    assert bebop.mass is not None
    thrust = mass * vehicle.motor.k_w / (bebop.mass * bebop.motor.k_w)  # relative to the Bebop's
    radius = config.rotors.radius or BEBOP_RADIUS_M * thrust**0.25
    motors = config.motors.replace(
        tau=config.motors.tau or float(vehicle.motor.tau),
        rpm_max=config.motors.rpm_max or float(vehicle.motor.rpm_max),
    )
    return config.replace(mass=mass, rotors=config.rotors.replace(radius=radius), motors=motors)


def build_plant(config: PlantConfig) -> PlantParams:
    """The plant's numbers.

    Raises:
        InputError: a vehicle or residual file that cannot be read.
    """
    config = filled(config)
    assert config.mass is not None
    residual = None if config.residual is None else read_residual(config.residual)
    vehicle = nominal_vehicle(config)
    nominal, own_mass = vehicle.motor, vehicle.mass
    factors, rotor_factors = drawn_factors(config)
    own = nominal.replace(tau=config.motors.tau)
    drawn_constants = {
        name: jnp.float32(getattr(own, name) * factor) for name, factor in factors.items()
    }
    fixed = {name: jnp.float32(getattr(nominal, name)) for name in NOT_DRAWN}
    hover, effects, rate = hover_rpm(nominal), config.effects, config.sample_rate
    return PlantParams(
        vehicle=VehicleParams(MotorConstants(**drawn_constants, **fixed), residual),
        rotor_factor=Rotors(*(jnp.float32(x) for x in rotor_factors)),
        effects=as_leaves(effects),
        airframe=make_airframe(config.airframe),
        rotors=as_leaves(config.rotors),
        motors=as_leaves(config.motors),
        imu=as_leaves(config.imu),
        gusts=as_leaves(config.gusts),
        battery=battery_params(config.battery, hover, nominal.rpm_max, effects.battery),
        mass=jnp.float32(config.mass),
        lightness=jnp.float32(1.0 if own_mass is None else own_mass / config.mass),
        hover=jnp.float32(hover),
        step=jnp.float32(1.0 / rate),
        command_delay=jnp.float32(config.delay.command * rate),
        commands_waiting=math.ceil(config.delay.command * rate),
        measurement_delay=round(config.delay.measurement * rate),
    )


def drawn_factors(config: PlantConfig) -> tuple[dict[str, float], np.ndarray]:
    """Factors on the drone's constants by name, and on the rotors' speeds (4,)."""
    random = np.random.default_rng(config.constants.seed)
    spread = config.constants.spread * config.effects.constants
    names = [name for name in constant_names(MotorConstants) if name not in NOT_DRAWN]
    factors = dict(zip(names, 1.0 + spread * random.uniform(-1.0, 1.0, len(names)), strict=True))
    spread = config.motors.rotor_spread * config.effects.constants
    return factors, 1.0 + spread * random.uniform(-1.0, 1.0, 4)


def begin(
    params: PlantParams, body: RigidBodyState, charge: jax.Array, draws: jax.Array
) -> PlantState:
    """A drone at the start: pending commands equal to its rotor speeds.

    ``charge`` () is that of the battery, 0 to 1; ``draws`` are (gusts.START_DRAWS,) normal numbers.
    """
    physics = Physics(body, jax.tree.map(jnp.zeros_like, body.actuators), charge)
    still, phase = Vec3.zero(), Rotors.of(jnp.zeros(4))
    line = (body.actuators,) * params.commands_waiting
    return PlantState(physics, still, phase, gusts.init(draws), line)


def forces(
    params: PlantParams, physics: Physics, rpm_rate: Rotors, air_velocity: Vec3
) -> tuple[Vec3, Vec3]:
    """Specific force, m/s^2, and moment, N m, of rotors and air, body frame.

    Of derivatives of the propeller speeds, rpm/s, and the velocity through the air, m/s, body.
    """
    body, c, on = physics.body, params.vehicle.constants, params.effects
    mass, rpm = params.mass, body.actuators * params.rotor_factor
    light = params.lightness
    in_air = BodyState(air_velocity, body.rates, rpm, rpm_rate)
    force, moment = motor.MODEL.force_moment(params.vehicle, in_air)
    lost = effects.advance_loss(params.rotors, c, air_velocity)
    lift = effects.ground_gain(params.rotors, c, mass, rpm, air_velocity, -body.position.z)
    flapping = effects.flapping_moment(params.rotors, c, mass, rpm, air_velocity, body.rates)
    turning = effects.gyroscopic_moment(c, rpm, body.rates)
    force = force.replace(z=force.z + (lost * on.inflow + lift * on.ground))
    moment = moment + flapping * on.flapping + turning * on.gyroscopic
    if params.airframe is None:
        return force * light, moment
    more_z, more_moment = airframe_force_moment(params.airframe, rpm, air_velocity, body.rates)
    force = force.replace(z=force.z + more_z * on.airframe_force)
    return force * light, moment + more_moment * on.airframe_moment


@materialized()
def derivative(params: PlantParams, physics: Physics, command: Rotors, wind: Vec3) -> Physics:
    """Time derivative under four rpm commands in a wind, m/s, world; as a ``Physics``."""
    body, c = physics.body, params.vehicle.constants
    a = attitude(body.euler)
    air_velocity = world_to_body(a, body.velocity - wind)
    on, motors = params.effects, params.motors
    top = highest_rpm(params.battery, body.actuators, physics.charge)
    target = effects.steady_speeds(command, on.motors * motors.shortfall, params.hover, top)
    rpm_rate, rpm_bend = effects.rotor_rates(
        c.tau,
        motors.slowing**on.motors,
        on.motors * motors.lag,
        body.actuators,
        physics.rpm_rate,
        target,
    )
    force, moment = forces(params, physics, rpm_rate, air_velocity)
    moment_ext, force_ext = body.disturbance
    acceleration = body_to_world(a, force + force_ext)
    turning = motor.angular_acceleration(c, moment + moment_ext, body.rates)
    return Physics(
        body=RigidBodyState(
            position=body.velocity,
            velocity=acceleration.replace(z=acceleration.z + c.g),
            attitude=euler_rates(a, body.rates),
            rates=turning,
            actuators=rpm_rate,
            moment_ext=Vec3.zero(),
            force_ext=Vec3.zero(),
        ),
        rpm_rate=rpm_bend,
        charge=charge_rate(params.battery, body.actuators),
    )


def update(
    params: PlantParams,
    state: PlantState,
    command: Rotors,
    draws: jax.Array,
    opaque_true: jax.Array | None = None,
) -> PlantState:
    """One drone one sample later.

    Args:
        params: of the plant.
        state: from ``begin`` or the last ``update``.
        command: rpm, clipped to the range of the motors.
        draws: (gusts.DRAWS,) standard normal numbers.
        opaque_true: of ``quadjax.core.materialize``, for the speed on CPUs only.
    """
    low, high = params.vehicle.constants.rpm_min, params.motors.rpm_max
    held = jax.tree.map(lambda u: jnp.clip(u, low, high), command)
    line = (*state.commands, held)
    applied = effects.delayed(line, params.command_delay)
    wind = gusts.velocity(params.gusts, state.gusts) * params.effects.gusts

    def slope(physics: Physics) -> Physics:
        return derivative(params, physics, applied, wind, opaque_true=opaque_true)

    physics = rk4_step(slope, state.physics, params.step)
    euler = physics.body.euler
    body = physics.body.replace(attitude=euler.replace(z=wrap_angle(euler.z)))
    turning = (body.rates - state.physics.body.rates) * (1.0 / params.step)
    phase = jax.tree.map(
        lambda angle, w: wrap_angle(angle + w * (params.step / RPM_PER_RAD_S)),
        state.phase,
        body.actuators,
    )
    gust = gusts.update(params.gusts, state.gusts, body.velocity, params.step, draws)
    return PlantState(physics.replace(body=body), turning, phase, gust, line[1:])


def truth_of(params: PlantParams, state: PlantState) -> GroundTruth:
    """The true motion at the sensors: of the center of gravity, and at the inertial unit."""
    body, on = state.physics.body, params.effects
    force, _ = loads(params, state)
    assert body.force_ext is not None
    lever = effects.lever_acceleration(params.imu, body.rates, state.turning)
    shaking, turning = effects.vibration(params.imu, params.hover, body.actuators, state.phase)
    return GroundTruth(
        position=body.position,
        velocity=body.velocity,
        euler=body.euler,
        rates=body.rates + turning * on.vibration,
        specific_force=force + body.force_ext + lever * on.offset + shaking * on.vibration,
        rpm=body.actuators,
    )


def loads(params: PlantParams, state: PlantState) -> tuple[Vec3, Vec3]:
    """Specific force, m/s^2, and moment, N m, body, without that of rotor acceleration."""
    body = state.physics.body
    wind = gusts.velocity(params.gusts, state.gusts) * params.effects.gusts
    air_velocity = world_to_body(attitude(body.euler), body.velocity - wind)
    steady = Rotors.same(jnp.zeros(()))
    return forces(params, state.physics, steady, air_velocity)
