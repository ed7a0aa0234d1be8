"""Plants with some effects, filter states to test with, and known motions."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import ekf, sensors
from quadjax.plant.config import NO_EFFECTS, PlantConfig, without_effects
from quadjax.plant.ekf import EkfParams, InertialSample, MotionEstimate, ekf_params
from quadjax.plant.sensor_config import (
    AccelerometerConfig,
    GyroConfig,
    MocapConfig,
    RpmConfig,
    SensorsConfig,
)
from quadjax.plant.sensors import GroundTruth
from tests.plant import reference
from tests.plant.reference import Nominal

RATE = 500.0
OFF = without_effects(PlantConfig())


def only(**strengths: float) -> PlantConfig:
    """The default plant with some effects."""
    return OFF.replace(effects=NO_EFFECTS.replace(**strengths))


# Only what makes signals late is left: low-pass filters and latency.
ONLY_LATE = SensorsConfig(
    gyro=GyroConfig(noise=0.0, bias=0.0, bias_walk=0.0),
    accelerometer=AccelerometerConfig(noise=0.0, bias=0.0, bias_walk=0.0),
    rpm=RpmConfig(noise=0.0, resolution=0.0),
    mocap=MocapConfig(position_noise=0.0, attitude_noise=0.0, dropout=0.0),
)
NO_ERRORS = ONLY_LATE.replace(
    gyro=ONLY_LATE.gyro.replace(low_pass=0.0),
    accelerometer=ONLY_LATE.accelerometer.replace(low_pass=0.0),
    mocap=ONLY_LATE.mocap.replace(latency=0.0),
)


def vec3(values: np.ndarray) -> Vec3:
    return Vec3.of(jnp.asarray(values, jnp.float32))


def quaternion_of(rotation: Rotation) -> Quaternion:
    x, y, z, w = rotation.as_quat()
    return Quaternion(*(jnp.float32(number) for number in (w, x, y, z)))


def rotation_of(q: Quaternion) -> Rotation:
    return Rotation.from_quat(np.stack([np.float64(x) for x in (q.x, q.y, q.z, q.w)], axis=-1))


def random_filter(seed: int) -> tuple[Nominal, np.ndarray, tuple[InertialSample, InertialSample]]:
    """A state in mid-flight, a covariance with every correlation, and two inertial samples."""
    random = np.random.default_rng(seed)
    state = Nominal(
        random.normal(size=3),
        4.0 * random.normal(size=3),
        Rotation.random(random_state=seed),
        0.01 * random.normal(size=3),
        0.1 * random.normal(size=3),
    )
    scales = np.repeat([1e-3, 2e-2, 3e-3, 5e-3, 0.1], 3)
    root = np.eye(15) + 0.2 * random.normal(size=(15, 15))
    covariance = scales[:, None] * (root @ root.T) * scales
    rates, force = 3.0 * random.normal(size=3), np.array([0.5, -0.4, -14.0])
    samples = tuple(
        InertialSample(vec3(rates + 0.1 * change), vec3(force + change), jnp.float32(1.0 / RATE))
        for change in random.normal(size=(2, 3))
    )
    return state, covariance, samples


def motion_of(state: Nominal) -> MotionEstimate:
    return MotionEstimate(
        vec3(state.position),
        vec3(state.velocity),
        quaternion_of(state.attitude),
        vec3(state.gyro_bias),
        vec3(state.force_bias),
    )


def nominal_of(motion: MotionEstimate) -> Nominal:
    vectors = (motion.position, motion.velocity, motion.gyro_bias, motion.force_bias)
    position, velocity, gyro, force = (np.float64(v.array()) for v in vectors)
    return Nominal(position, velocity, rotation_of(motion.attitude), gyro, force)


def correlation(covariance: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """Covariances (.., 15, 15) in units of the standard deviations of others."""
    deviations = np.sqrt(np.diagonal(scale, axis1=-2, axis2=-1))
    return covariance / (deviations[..., :, None] * deviations[..., None, :])


def loop(time: np.ndarray, turn_rate: float = 4.0) -> dict[str, np.ndarray]:
    """Loops at a steady rate, nose over: pitch goes through 90 deg twice in each turn.

    Position, velocity, attitude as a rotation vector, rates and specific force, (samples, 3).
    """
    angle, radius, zero = turn_rate * time, 1.5, np.zeros_like(time)
    # Round a circle in the plane y = 0, the body's z axis pointing outwards: x forward.
    outward = np.stack([np.sin(angle), zero, np.cos(angle)], axis=-1)
    forward = np.stack([np.cos(angle), zero, -np.sin(angle)], axis=-1)
    turn = np.stack([zero, angle, zero], axis=-1)
    acceleration = -radius * turn_rate**2 * outward
    return {
        "position": radius * outward,
        "velocity": radius * turn_rate * forward,
        "attitude": turn,
        "rates": np.stack([zero, zero + turn_rate, zero], axis=-1),
        "force": Rotation.from_rotvec(turn).inv().apply(acceleration - reference.GRAVITY),
    }


def truth_of(motion: dict[str, np.ndarray], drones: int) -> GroundTruth:
    """The same motion of several drones: samples first, drones last."""
    euler = Rotation.from_rotvec(motion["attitude"]).as_euler("ZYX")[:, ::-1]
    vectors = (motion["position"], motion["velocity"], euler, motion["rates"], motion["force"])
    samples = len(euler)

    def each(rows: np.ndarray) -> Vec3:
        wide = np.broadcast_to(rows.T[:, :, None], (3, samples, drones))
        return Vec3(*(jnp.asarray(row, jnp.float32) for row in wide))

    rpm = Rotors.same(jnp.full((samples, drones), 7000.0))
    return GroundTruth(*(each(x) for x in vectors), rpm)


def at(tree: object, index: object) -> object:
    return jax.tree.map(lambda x: x[index], tree)


@dataclasses.dataclass(frozen=True)
class Filtered:
    """The filter on loops: arrays of samples first, drones last."""

    errors: np.ndarray  # (samples, drones, 15) at the delayed instant
    covariance: np.ndarray  # (samples, drones, 15, 15)
    present: dict[str, np.ndarray]  # (samples, drones, 3), errors of the present estimate

    @property
    def nees(self) -> np.ndarray:
        """Normalized errors squared, (samples, drones): 15 on average of a consistent filter."""
        weighted = np.linalg.solve(self.covariance, self.errors[..., None])[..., 0]
        return (self.errors * weighted).sum(axis=-1)


def filtered(config: SensorsConfig, seed: int, noise: float = 1.0, drones: int = 24) -> Filtered:
    """Sensors and filter of some drones on a loop of 1.6 s, at 500 samples a second.

    The assumed noise is multiplied by ``noise``.
    """
    own, params = sensors.sensor_params(config, RATE), ekf_params(config, RATE)
    params = params.replace(noise=noise * params.noise)
    time = np.arange(801) / RATE
    motion = loop(time)
    found = _filter(own, params, truth_of(motion, drones), jax.random.key(seed))
    states, (present, rates), biases = jax.tree.map(np.float64, found)
    late = params.lag / RATE + float(params.late)
    then = {name: x[1:, None] for name, x in loop(np.maximum(time - late, 0.0)).items()}
    now = {name: x[1:, None] for name, x in motion.items()}
    estimate = states.motion
    return Filtered(
        errors=np.concatenate(
            [
                then["position"] - estimate.position.array(),
                then["velocity"] - estimate.velocity.array(),
                _turned(then["attitude"], estimate.attitude),
                biases[0].array() - estimate.gyro_bias.array(),
                biases[1].array() - estimate.force_bias.array(),
            ],
            axis=-1,
        ),
        covariance=np.moveaxis(states.covariance, -1, 1),
        present={
            "position": now["position"] - present.position.array(),
            "velocity": now["velocity"] - present.velocity.array(),
            "attitude": _turned(now["attitude"], present.attitude),
            "rates": now["rates"] - rates.array(),
        },
    )


def _turned(true: np.ndarray, estimated: Quaternion) -> np.ndarray:
    """Rotation vectors (samples, drones, 3), rad, from the estimated attitude to the true one."""
    shape = np.shape(estimated.w)
    wide = np.broadcast_to(true, (*shape, 3)).reshape(-1, 3)
    back = rotation_of(jax.tree.map(np.ravel, estimated)).inv()
    return (Rotation.from_rotvec(wide) * back).as_rotvec().reshape(*shape, 3)


@jax.jit
def _filter(
    own: sensors.SensorParams, params: EkfParams, truth: GroundTruth, key: jax.Array
) -> tuple:
    samples, drones = truth.position.x.shape

    def start(truth: GroundTruth, drawn: jax.Array) -> tuple:
        state, measured = sensors.init(own, truth, drawn)
        return state, ekf.init(params, measured)

    def update(carry: tuple, truth: GroundTruth, drawn: jax.Array) -> tuple:
        state, measured = sensors.update(own, carry[0], truth, drawn)
        estimated = ekf.update(params, carry[1], measured)
        biases = state.gyro.bias, state.accelerometer.bias
        return (state, estimated), (estimated, ekf.estimate(params, estimated), biases)

    def one(carry: tuple, now: tuple) -> tuple:
        drawn = jax.random.normal(now[1], (sensors.DRAWS, drones))
        return jax.vmap(update, -1, -1)(carry, now[0], drawn)

    drawn = jax.random.normal(key, (sensors.START_DRAWS, drones))
    carry = jax.vmap(start, -1, -1)(at(truth, 0), drawn)
    keys = jax.random.split(jax.random.fold_in(key, 1), samples - 1)
    return jax.lax.scan(one, carry, (at(truth, slice(1, None)), keys))[1]
