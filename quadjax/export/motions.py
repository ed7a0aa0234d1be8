"""Measurements of made-up motions, and the estimators of ``quadjax.vehicle`` on them in float64."""

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.vectors import Rotors, Vec3
from quadjax.vehicle import battery, estimator, motor
from quadjax.vehicle.battery import LimitEstimatorState as Limit
from quadjax.vehicle.estimator import EstimatorState
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import Measurement, VehicleParams

# Standard deviation of the noise: gyro, rad/s; accelerometer, m/s^2; rpm; body velocity, m/s.
NOISE = np.array([0.1] * 3 + [0.5] * 3 + [20.0] * 4 + [0.02] * 3)


def tumbling(rng: np.random.Generator, rate: float, seconds: float) -> np.ndarray:
    """Measurements of a tumbling drone, (n, 13) float32 at ``rate`` Hz, with noise."""
    t = np.arange(round(rate * seconds)) / rate
    gyro = [8.0 * np.sin(2 * np.pi * f * t + f) for f in (1.3, 2.1, 0.7)]
    force = [5.0 * np.sin(3 * t), 4.0 * np.cos(2 * t), -9.8 + 6.0 * np.sin(7 * t)]
    rpm = [7500.0 + 2500.0 * np.sin(9 * t + i) for i in range(4)]
    velocity = [6.0 * np.sin(t), 3.0 * np.sin(2 * t), 2.0 * np.cos(t)]
    clean = np.stack([*gyro, *force, *rpm, *velocity], axis=1)
    return (clean + NOISE * rng.standard_normal(clean.shape)).astype(np.float32)


def estimate_float64(
    vehicle: VehicleParams, measured: np.ndarray, rate: float, cutoff: float
) -> np.ndarray:
    """Moments and forces (n, 6) of ``quadjax.vehicle.estimator`` in float64, of (n, 13)."""
    with jax.enable_x64(True):
        exact = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), vehicle)
        params = estimator.estimator_params(motor.MODEL, exact, rate, cutoff)
        columns = jnp.asarray(measured, jnp.float64).T
        gyro, force, velocity = (Vec3(*columns[i : i + 3]) for i in (0, 3, 10))
        samples = Measurement(gyro, force, Rotors(*columns[6:10]), velocity)

        def one(state: EstimatorState, sample: Measurement) -> tuple[EstimatorState, jax.Array]:
            state, *vectors = estimator.update(params, state, sample)
            return state, jnp.stack(jax.tree.leaves(vectors))

        start = estimator.init(params, jax.tree.map(lambda x: x[0], samples))
        return np.asarray(jax.lax.scan(one, start, samples)[1])


def full_power_bursts(
    rng: np.random.Generator, c: MotorConstants, rate: float, seconds: float
) -> np.ndarray:
    """Speeds and commands (n, 8) float32, rpm, of an emptying battery, with noise.

    Each motor is at full power and at a random speed in turn, 0.2 s each.
    """
    top, lag, count = float(c.rpm_max), float(c.tau), round(rate * seconds)
    turn = (np.arange(count)[:, None] / rate / 0.2 + np.arange(4) / 4).astype(int)
    levels = rng.uniform(0.4, 1.0, (turn.max() + 1, 4)) * top
    command = np.where(turn % 2 == 0, top, np.take_along_axis(levels, turn, axis=0))
    limit = top * np.linspace(0.95, 0.8, count)[:, None]
    pull, rpm = 1.0 - np.exp(-1.0 / (lag * rate)), [np.full(4, 0.6 * top)]
    for reached in np.minimum(command, limit)[:-1]:
        rpm.append(rpm[-1] + pull * (reached - rpm[-1]))
    measured = np.stack(rpm) + NOISE[6] * rng.standard_normal((count, 4))
    return np.concatenate([measured, command], axis=1).astype(np.float32)


def highest_float64(
    c: MotorConstants, first: float, samples: np.ndarray, rate: float
) -> np.ndarray:
    """Estimates (n,), rpm, of ``quadjax.vehicle.battery`` in float64, from samples (n, 8)."""
    with jax.enable_x64(True):
        top, lag = (jnp.float64(float(x)) for x in (c.rpm_max, c.tau))
        params, rows = battery.limit_estimator(top, lag, rate), jnp.asarray(samples, jnp.float64)

        def one(state: Limit, row: jax.Array) -> tuple[Limit, jax.Array]:
            state = battery.update(params, state, Rotors.of(row[:4]), Rotors.of(row[4:]))
            return state, state.highest

        start = battery.begin(params, Rotors.of(rows[0, :4]), jnp.float64(first))
        later = jax.lax.scan(one, start, rows[1:])[1]
        return np.asarray(jnp.concatenate([start.highest[None], later]))
