"""Filter states to test with, and known motions."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.consistency import errors_and_deviations
from quadjax.core.matrix import Mat3, Sym3
from quadjax.core.quaternion import Quaternion
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import ekf, sensors
from quadjax.plant.config import (
    AccelerometerConfig,
    EkfConfig,
    GyroConfig,
    MocapConfig,
    RpmConfig,
    SensorsConfig,
)
from quadjax.plant.covariance import Covariance
from quadjax.plant.ekf import InertialSample, MotionEstimate
from quadjax.plant.ekf_params import EkfParams, ekf_params
from quadjax.plant.sensors import GroundTruth
from tests.plant.reference import Nominal

RATE = 500.0
# Only what makes signals late is left: low-pass filters and latency.
ONLY_LATE = SensorsConfig(
    gyro=GyroConfig(noise=0.0, bias=0.0, bias_walk=0.0),
    accelerometer=AccelerometerConfig(noise=0.0, bias=0.0, bias_walk=0.0),
    rpm=RpmConfig(noise=0.0, resolution=0.0),
    mocap=MocapConfig(position_noise=0.0, attitude_noise=0.0, dropout=0.0),
)
NO_ERRORS = SensorsConfig(
    gyro=GyroConfig(noise=0.0, bias=0.0, bias_walk=0.0, low_pass=0.0),
    accelerometer=AccelerometerConfig(noise=0.0, bias=0.0, bias_walk=0.0, low_pass=0.0),
    rpm=RpmConfig(noise=0.0, resolution=0.0),
    mocap=MocapConfig(latency=0.0, position_noise=0.0, attitude_noise=0.0, dropout=0.0),
)
EXACT = EkfConfig(start_gyro_bias=0.0, start_accelerometer_bias=0.0)


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


def covariance_of(dense: np.ndarray) -> Covariance:
    def block(i: int, j: int) -> Mat3:
        return Mat3(*(vec3(row) for row in dense[3 * i : 3 * i + 3, 3 * j : 3 * j + 3]))

    return Covariance(
        tuple(Sym3.of(block(i, i)) for i in range(5)),
        tuple(block(i, j) for i in range(5) for j in range(i + 1, 5)),
    )


def correlation(dense: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """A covariance in units of the standard deviations of another."""
    return dense / np.sqrt(np.outer(np.diag(scale), np.diag(scale)))


def loop(samples: int, drones: int, turn_rate: float = 4.0) -> GroundTruth:
    """Loops at a steady rate, nose over: pitch goes through 90 deg twice in each turn.

    Samples first, drones last; the first sample is the start.
    """
    time = np.arange(samples) / RATE
    angle = turn_rate * time
    radius, zero = 1.5, np.zeros_like(time)
    # Round a circle in the plane y = 0, the body's z axis pointing outwards: x forward.
    position = radius * np.stack([np.sin(angle), zero, np.cos(angle)])
    velocity = radius * turn_rate * np.stack([np.cos(angle), zero, -np.sin(angle)])
    outward = position / radius
    acceleration = -radius * turn_rate**2 * outward
    body = Rotation.from_rotvec(np.stack([zero, angle, zero], axis=-1))
    force = body.inv().apply(acceleration.T - np.array([0.0, 0.0, 9.81])).T
    yaw, pitch, roll = body.as_euler("ZYX").T
    rates = np.stack([zero, zero + turn_rate, zero])

    def each(rows: np.ndarray) -> Vec3:
        wide = np.broadcast_to(rows[:, :, None], (3, samples, drones))
        return Vec3(*(jnp.asarray(row, jnp.float32) for row in wide))

    euler = np.stack([roll, pitch, yaw])
    rpm = Rotors.same(jnp.full((samples, drones), 7000.0))
    return GroundTruth(*(each(x) for x in (position, velocity, euler, rates, force)), rpm)


def at(tree: object, index: object) -> object:
    return jax.tree.map(lambda x: x[index], tree)


def filtered(
    config: SensorsConfig, assumed: EkfConfig, truth: GroundTruth, seed: int
) -> tuple[np.ndarray, ekf.EkfState]:
    """Sensors and filter on a known motion whose first sample is the start.

    Errors and standard deviations (samples - 1, 2, 7, 3, drones), and the final filters.
    """
    own, params = sensors.sensor_params(config, RATE), ekf_params(config, assumed, RATE)
    numbers, estimated = _filter(own, params, truth, jax.random.key(seed))
    return np.float64(numbers), estimated


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
        return (state, estimated), errors_and_deviations(params, estimated, truth, state)

    def one(carry: tuple, now: tuple) -> tuple:
        drawn = jax.random.normal(now[1], (sensors.DRAWS, drones))
        return jax.vmap(update, -1, -1)(carry, now[0], drawn)

    drawn = jax.random.normal(key, (sensors.START_DRAWS, drones))
    carry = jax.vmap(start, -1, -1)(at(truth, 0), drawn)
    keys = jax.random.split(jax.random.fold_in(key, 1), samples - 1)
    (_, estimated), numbers = jax.lax.scan(one, carry, (at(truth, slice(1, None)), keys))
    return numbers, estimated
