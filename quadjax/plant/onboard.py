"""Onboard computers of a drone: sensors, navigation filter, disturbance estimator, inner loop.

One sample goes from the true motion to the state that a policy observes. With ``navigation``
"ground_truth" the motion is known exactly, for development.
"""

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core import quaternion
from quadjax.core.errors import InputError
from quadjax.core.gradients import Scalar
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import ekf, gusts, indi, indi_simple, plant, sensors
from quadjax.plant.config import PlantConfig
from quadjax.plant.ekf import EkfParams, EkfState, ekf_params
from quadjax.plant.indi import IndiParams, IndiState
from quadjax.plant.indi_simple import SimpleParams, SimpleState
from quadjax.plant.plant import PlantParams, PlantState, nominal_vehicle
from quadjax.plant.sensors import GroundTruth, Measured, SensorParams, SensorState
from quadjax.vehicle import battery, motor
from quadjax.vehicle import estimator as disturbance
from quadjax.vehicle.battery import LimitEstimatorParams, LimitEstimatorState
from quadjax.vehicle.estimator import EstimatorParams, EstimatorState, estimator_params
from quadjax.vehicle.protocol import Measurement, VehicleParams
from quadjax.vehicle.rate import RateCommand
from quadjax.vehicle.rigid_body import BodyState, RigidBodyState

DRAWS = sensors.DRAWS + gusts.DRAWS


class OnboardParams(struct.PyTreeNode):
    """Numbers of the onboard computers, and two static settings."""

    sensors: SensorParams
    ekf: EkfParams
    estimator: EstimatorParams  # with the onboard model of the drone
    inner: IndiParams | SimpleParams
    limit: LimitEstimatorParams  # of the battery's limit
    first_limit: jax.Array  # rpm, its first estimate
    navigation: str = struct.field(pytree_node=False, default="ekf")  # ekf, ground_truth
    disturbance: str = struct.field(
        pytree_node=False, default="estimated"
    )  # .., ground_truth, none


class StateEstimate(struct.PyTreeNode):
    """Estimate of the drone's state at one sample."""

    motion: RigidBodyState  # with the external moment and force that the policy observes
    measurement: Measurement  # less the estimated biases
    gyro: Vec3  # rad/s, as measured
    accelerometer: Vec3  # m/s^2, as measured
    force_bias: Vec3  # m/s^2, estimated bias of the accelerometer


class OnboardState(struct.PyTreeNode):
    """State of the onboard computers between samples."""

    delayed: tuple[GroundTruth, ...]  # on its way to the sensors, the oldest first
    sensors: SensorState | None
    ekf: EkfState | None
    estimator: EstimatorState
    inner: IndiState | SimpleState
    limit: LimitEstimatorState
    estimate: StateEstimate


def onboard_params(
    config: PlantConfig, model: VehicleParams, first_limit: Scalar | None = None
) -> OnboardParams:
    """Sensors, filters and inner loop.

    Args:
        config: of the plant.
        model: the onboard model, of the motor-level vehicle.
        first_limit: () the battery's limit at first, rpm; None: the highest command.

    Raises:
        InputError: a vehicle file that cannot be read.
    """
    rate, c = config.sample_rate, model.constants
    return OnboardParams(
        sensors=sensors.sensor_params(config.sensors, rate),
        ekf=ekf_params(config.sensors, rate, float(c.g)),
        estimator=estimator_params(motor.MODEL, model, rate),
        inner=inner_params(config),
        limit=battery.limit_estimator(c.rpm_max, c.tau, rate),
        first_limit=jnp.asarray(c.rpm_max if first_limit is None else first_limit, jnp.float32),
        navigation=config.navigation,
        disturbance=config.disturbance,
    )


def inner_params(config: PlantConfig) -> IndiParams | SimpleParams:
    """The inner loop of a plant, with what it does not say from its vehicle's model.

    Raises:
        InputError: an effectiveness of another drone.
    """
    rate, c, highest = config.sample_rate, nominal_vehicle(config).motor, config.motors.rpm_max
    highest = highest or float(c.rpm_max)
    if config.inner_loop == "indi":
        return indi.indi_params(c.replace(rpm_max=highest), config.indi, rate)
    numbers = config.indi_simple
    effectiveness, thrust_gain = indi_simple.nominal_effectiveness(c, highest, rate)
    given = numbers.effectiveness or effectiveness
    if not 0.5 < given[0] / effectiveness[0] < 2.0:
        raise InputError(
            f"indi_simple.effectiveness is {list(given)}, but the model of {config.vehicle} has "
            f"{effectiveness[0]:.3g} in roll: null takes those of the model"
        )
    gain = numbers.thrust_gain or thrust_gain
    numbers = numbers.replace(effectiveness=given, thrust_gain=gain)
    return indi_simple.simple_params(c, numbers, highest, rate)


def begin(
    params: OnboardParams, body: PlantParams, state: PlantState, draws: jax.Array
) -> OnboardState:
    """The initial state of a drone; ``draws`` holds (sensors.START_DRAWS,) normal numbers."""
    truth = plant.truth_of(body, state)
    sensor_state = filtered = measured = None
    if params.navigation == "ekf":
        sensor_state, measured = sensors.init(params.sensors, truth, draws)
        filtered = ekf.init(params.ekf, measured)
    now = _estimate(params, truth, measured, filtered)
    estimated = disturbance.init(params.estimator, now.measurement)
    loop = indi_simple if isinstance(params.inner, SimpleParams) else indi
    inner = loop.init(params.inner, now.measurement)
    limit = battery.begin(params.limit, now.measurement.actuators, params.first_limit)
    line = (truth,) * body.measurement_delay
    return OnboardState(line, sensor_state, filtered, estimated, inner, limit, now)


def sense(
    params: OnboardParams,
    body: PlantParams,
    state: PlantState,
    onboard: OnboardState,
    command: Rotors,
    draws: jax.Array,
) -> OnboardState:
    """One sample of sensors, filter and estimators; the inner loop is ``command_rotors``.

    Args:
        params: of the onboard computers.
        body: of the plant.
        state: of the plant, now.
        onboard: from ``begin`` or the last sample.
        command: of the sample before, rpm.
        draws: (sensors.DRAWS,) standard normal numbers.
    """
    truth, *waiting = (*onboard.delayed, plant.truth_of(body, state))
    sensor_state, filtered, measured = onboard.sensors, onboard.ekf, None
    if sensor_state is not None and filtered is not None:
        sensor_state, measured = sensors.update(params.sensors, sensor_state, truth, draws)
        filtered = ekf.update(params.ekf, filtered, measured)
    now = _estimate(params, truth, measured, filtered)
    estimated, moment, force = disturbance.update(
        params.estimator, onboard.estimator, now.measurement
    )
    if params.disturbance == "ground_truth":
        moment, force = unmodeled(params, body, state)
    elif params.disturbance == "none":
        moment, force = Vec3.zero(), Vec3.zero()
    now = now.replace(motion=now.motion.replace(moment_ext=moment, force_ext=force))
    limit = battery.update(params.limit, onboard.limit, now.measurement.actuators, command)
    return OnboardState(
        tuple(waiting), sensor_state, filtered, estimated, onboard.inner, limit, now
    )


def _estimate(
    params: OnboardParams, truth: GroundTruth, measured: Measured | None, filtered: EkfState | None
) -> StateEstimate:
    none = Vec3.zero()
    if filtered is None or measured is None:
        rpm, gyro, accelerometer = truth.rpm, truth.rates, truth.specific_force
        position, velocity, euler, rates = truth.position, truth.velocity, truth.euler, truth.rates
        gyro_bias = force_bias = none
    else:
        now, rates = ekf.estimate(params.ekf, filtered)
        rpm, gyro, accelerometer = measured.rpm, measured.gyro, measured.accelerometer
        position, velocity, euler = now.position, now.velocity, quaternion.to_euler(now.attitude)
        gyro_bias, force_bias = now.gyro_bias, now.force_bias
    motion = RigidBodyState(position, velocity, euler, rates, rpm, none, none)
    body_velocity = motion.to_body(velocity)
    measurement = Measurement(gyro - gyro_bias, accelerometer - force_bias, rpm, body_velocity)
    return StateEstimate(motion, measurement, gyro, accelerometer, force_bias)


def unmodeled(params: OnboardParams, body: PlantParams, state: PlantState) -> tuple[Vec3, Vec3]:
    """True moment, N m, and specific force, m/s^2, body, that the onboard model lacks."""
    true = state.physics.body
    steady = BodyState.steady(true.to_body(true.velocity), true.rates, true.actuators)
    force, moment = motor.MODEL.force_moment(params.estimator.vehicle, steady)
    own_force, own_moment = plant.loads(body, state)
    return own_moment - moment, own_force - force


def command_rotors(
    params: OnboardParams, onboard: OnboardState, command: Rotors | RateCommand
) -> tuple[OnboardState, Rotors]:
    """Rpm commands of a policy's command: the command itself, or the inner loop's."""
    if isinstance(command, Rotors):
        return onboard, command
    loop = indi_simple if isinstance(params.inner, SimpleParams) else indi
    inner, rotors = loop.update(params.inner, onboard.inner, onboard.estimate.measurement, command)
    return onboard.replace(inner=inner), rotors
