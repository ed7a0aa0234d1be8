"""What a drone carries and believes: sensors, navigation filter, disturbance estimator, inner loop.

One sample goes from what is true to what a policy sees. With ``navigation`` "truth" the motion is
known exactly, for development; the estimates are what policies are flown with.
"""

import dataclasses

import jax
import jax.numpy as jnp
from flax import struct

from quadjax.core.frames import attitude, world_to_body
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import ekf, gusts, indi, plant, sensors
from quadjax.plant.ekf import EkfState
from quadjax.plant.ekf_params import EkfParams
from quadjax.plant.estimate import estimate
from quadjax.plant.indi import Felt, IndiParams, IndiState
from quadjax.plant.plant import PlantParams, PlantState
from quadjax.plant.sensors import SensorParams, SensorState
from quadjax.plant.truth import Truth
from quadjax.vehicle import estimator as disturbance
from quadjax.vehicle import motor
from quadjax.vehicle.estimator import EstimatorParams, EstimatorState
from quadjax.vehicle.motor import MotorState
from quadjax.vehicle.protocol import Measurement
from quadjax.vehicle.rate import RateCommand


@dataclasses.dataclass(frozen=True)
class OnboardChoices:
    """What chooses code."""

    navigation: str = "ekf"  # "ekf" | "truth"
    disturbance_input: str = "estimated"  # "true" | "estimated" | "none"


@struct.dataclass
class OnboardParams:
    """Numbers of what the drone carries."""

    sensors: SensorParams
    ekf: EkfParams
    estimator: EstimatorParams  # its vehicle is the model that the drone believes in
    inner: IndiParams


@struct.dataclass
class Belief:
    """What is believed of the drone at one sample."""

    motion: MotorState  # with the external moment and force that the policy is told
    felt: Felt  # what the inner loop measures
    gyro: Vec3  # rad/s, as measured
    accelerometer: Vec3  # m/s^2, as measured
    force_bias: Vec3  # m/s^2, of the accelerometer, as believed


@struct.dataclass
class OnboardState:
    """What the drone's own computers carry from sample to sample."""

    delayed: tuple[Truth, ...]  # on its way to the sensors, the oldest first
    sensors: SensorState | None
    ekf: EkfState | None
    estimator: EstimatorState
    inner: IndiState
    belief: Belief


def begin(
    choices: OnboardChoices,
    params: OnboardParams,
    body: PlantParams,
    state: PlantState,
    drawn: jax.Array,
) -> OnboardState:
    """Everything switched on, of a drone at its start and (sensors.START_DRAWS,) normal numbers."""
    truth = plant.truth_of(body, state)
    carried = filtered = measured = None
    if choices.navigation == "ekf":
        carried, measured = sensors.init(params.sensors, truth, drawn)
        filtered = ekf.init(params.ekf, measured)
    belief = _believe(params, truth, measured, filtered)
    estimated = disturbance.init(params.estimator, _measurement(belief))
    inner = indi.init(params.inner, belief.felt)
    line = (truth,) * body.measurement_delay
    return OnboardState(line, carried, filtered, estimated, inner, belief)


def sense(
    choices: OnboardChoices,
    params: OnboardParams,
    body: PlantParams,
    state: PlantState,
    carried: OnboardState,
    drawn: jax.Array,
) -> OnboardState:
    """One sample of everything on board but the inner loop.

    Args:
        choices: what is flown with.
        params: of what the drone carries.
        body: of the plant.
        state: of the plant, now.
        carried: from ``begin`` or the last sample.
        drawn: (sensors.DRAWS,) standard normal numbers.
    """
    truth, *waiting = (*carried.delayed, plant.truth_of(body, state))
    own, filtered, measured = carried.sensors, carried.ekf, None
    if choices.navigation == "ekf":
        own, measured = sensors.update(params.sensors, own, truth, drawn)
        filtered = ekf.update(params.ekf, filtered, measured)
    belief = _believe(params, truth, measured, filtered)
    estimated, moment, force = disturbance.update(
        params.estimator, carried.estimator, _measurement(belief)
    )
    if choices.disturbance_input == "true":
        moment, force = unmodelled(params, body, state)
    elif choices.disturbance_input == "none":
        moment, force = Vec3.zero(), Vec3.zero()
    motion = belief.motion.replace(moment_ext=moment, force_ext=force)
    belief = belief.replace(motion=motion)
    return OnboardState(tuple(waiting), own, filtered, estimated, carried.inner, belief)


def _believe(
    params: OnboardParams,
    truth: Truth,
    measured: sensors.Measured | None,
    filtered: EkfState | None,
) -> Belief:
    none = Vec3.zero()
    if filtered is None:
        motion = MotorState(
            truth.position, truth.velocity, truth.euler, truth.rates, truth.rpm, none, none
        )
        felt = Felt(truth.rates, truth.specific_force.z, truth.rpm)
        return Belief(motion, felt, truth.rates, truth.specific_force, none)
    now = estimate(params.ekf, filtered).value
    motion = MotorState(now.position, now.velocity, now.euler, now.rates, measured.rpm, none, none)
    force_z = measured.accelerometer.z - now.accelerometer_bias.z
    felt = Felt(measured.gyro - now.gyro_bias, force_z, measured.rpm)
    bias = now.accelerometer_bias
    return Belief(motion, felt, measured.gyro, measured.accelerometer, bias)


def _measurement(belief: Belief) -> Measurement:
    """What the estimator of the disturbance takes."""
    velocity = world_to_body(attitude(belief.motion.euler), belief.motion.velocity)
    force = belief.accelerometer - belief.force_bias
    return Measurement(belief.felt.gyro, force, belief.felt.rpm, velocity)


def unmodelled(params: OnboardParams, body: PlantParams, state: PlantState) -> tuple[Vec3, Vec3]:
    """Moment, N m, and specific force, m/s^2, body, that the believed model lacks, exactly."""
    true = state.physics.body
    velocity = world_to_body(attitude(true.euler), true.velocity)
    still = Rotors.same(jnp.zeros(()))
    model = params.estimator.vehicle
    force, moment = motor.force_moment(model, true.rpm, still, velocity, true.rates)
    own_force, own_moment = plant.loads(body, state)
    return own_moment - moment, own_force - force


def command_rotors(
    params: OnboardParams, carried: OnboardState, command: Rotors | RateCommand
) -> tuple[OnboardState, Rotors]:
    """Rpm commands of a policy's command: its own, or those of the inner loop."""
    if isinstance(command, Rotors):
        return carried, command
    inner, rotors = indi.update(params.inner, carried.inner, carried.belief.felt, command)
    return carried.replace(inner=inner), rotors


DRAWS = sensors.DRAWS + gusts.DRAWS
