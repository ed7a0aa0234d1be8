"""Measurements for checks of the estimators: of simulated flights and of made-up motions."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.interpolate import CubicSpline

from quadjax.core.frames import attitude, world_to_body
from quadjax.core.vectors import Rotors, Vec3
from quadjax.export.integers import enable_x64
from quadjax.race.laps import Trace
from quadjax.vehicle import battery, estimator, motor
from quadjax.vehicle.motor import MODEL, MotorConstants
from quadjax.vehicle.protocol import Measurement, VehicleParams
from quadjax.vehicle.rigid_body import BodyState

# Standard deviation of the noise: gyro, rad/s; accelerometer, m/s^2; rpm; body velocity, m/s.
NOISE = np.array([0.1] * 3 + [0.5] * 3 + [20.0] * 4 + [0.02] * 3)
PUSH = np.array([0.3, -0.2, 0.4])  # m/s^2, an external force for the estimator to find


def _noisy(rng: np.random.Generator, clean: np.ndarray) -> np.ndarray:
    return (clean + NOISE * rng.standard_normal(clean.shape)).astype(np.float32)


def tumbling(rng: np.random.Generator, rate: float, seconds: float) -> np.ndarray:
    """Measurements of a tumbling drone, (n, 13) float32 at ``rate`` Hz, with noise."""
    t = np.arange(round(rate * seconds)) / rate
    gyro = [8.0 * np.sin(2 * np.pi * f * t + f) for f in (1.3, 2.1, 0.7)]
    force = [5.0 * np.sin(3 * t), 4.0 * np.cos(2 * t), -9.8 + 6.0 * np.sin(7 * t)]
    rpm = [7500.0 + 2500.0 * np.sin(9 * t + i) for i in range(4)]
    velocity = [6.0 * np.sin(t), 3.0 * np.sin(2 * t), 2.0 * np.cos(t)]
    return _noisy(rng, np.stack([*gyro, *force, *rpm, *velocity], axis=1))


def simulated(
    rng: np.random.Generator, vehicle: VehicleParams, trace: Trace, dt: float, rate: float
) -> np.ndarray:
    """Measurements of simulated flights, (runs, n, 13) float32 at ``rate`` Hz, with noise.

    Args:
        rng: of the noise.
        vehicle: its forces and ``PUSH`` are what the accelerometer measures.
        trace: a step every ``dt`` seconds, by cubic splines in between, until a run ends.
        dt: time step of the trace, s.
        rate: of the samples, Hz.
    """
    parts = (trace.velocity, trace.euler, trace.rates, trace.actuators)
    rows = [np.asarray(part, np.float64) for part in parts]  # (time, k, runs)
    rows[1] = np.unwrap(rows[1], axis=0)
    steps = int(np.min(np.sum(~np.asarray(trace.over), axis=0)))
    state = np.moveaxis(np.concatenate(rows, axis=1)[:steps], 2, 0)
    samples = np.arange(int(rate * dt * (steps - 1))) / rate
    between = CubicSpline(dt * np.arange(steps), state, axis=1)(samples)
    measure = jax.jit(jax.vmap(jax.vmap(functools.partial(_measure, vehicle))))
    return _noisy(rng, np.asarray(measure(jnp.asarray(between, jnp.float32)), np.float64))


def _measure(vehicle: VehicleParams, state: jax.Array) -> jax.Array:
    velocity, euler, rates = (Vec3.of(state[i : i + 3]) for i in (0, 3, 6))
    rpm = Rotors.of(state[9:13])
    seen = world_to_body(attitude(euler), velocity)
    force, _ = MODEL.force_moment(vehicle, BodyState.steady(seen, rates, rpm))
    force = force + Vec3(*(jnp.float32(x) for x in PUSH))
    numbers = [rates, force, rpm, seen]
    return jnp.stack([x for vector in numbers for x in vector.components()])


def estimate_float64(
    vehicle: VehicleParams, measured: np.ndarray, rate: float, cutoff: float
) -> np.ndarray:
    """Moments and forces (runs, n, 6) of ``quadjax.vehicle.estimator`` in float64."""
    with enable_x64(True):
        exact = jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), vehicle)
        return _estimate(exact, jnp.asarray(measured, jnp.float64), rate, cutoff)


def _estimate(
    vehicle: VehicleParams, measured: jax.Array, rate: float, cutoff: float
) -> np.ndarray:
    params = estimator.estimator_params(motor.MODEL, vehicle, rate, cutoff)

    def measurement(row: jax.Array) -> Measurement:
        gyro, force, velocity = (Vec3.of(row[i : i + 3]) for i in (0, 3, 10))
        return Measurement(gyro, force, Rotors.of(row[6:10]), velocity)

    def one(
        state: estimator.EstimatorState, row: jax.Array
    ) -> tuple[estimator.EstimatorState, jax.Array]:
        state, moment, force = estimator.update(params, state, measurement(row))
        return state, jnp.stack([*moment.components(), *force.components()])

    def run(rows: jax.Array) -> jax.Array:
        return jax.lax.scan(one, estimator.init(params, measurement(rows[0])), rows)[1]

    return np.asarray(jax.jit(jax.vmap(run))(measured))


def speeds_and_commands(
    rng: np.random.Generator, trace: Trace, dt: float, rate: float
) -> np.ndarray:
    """Propeller speeds with noise and held commands of flights, (runs, n, 8) float32, rpm.

    Args:
        rng: of the noise.
        trace: a step every ``dt`` seconds, until a run ends.
        dt: time step of the trace, s.
        rate: of the samples, Hz.
    """
    steps = int(np.min(np.sum(~np.asarray(trace.over), axis=0)))
    times = np.arange(1, int(rate * dt * (steps - 1))) / rate
    held = np.ceil(times / dt - 1e-9).astype(int) - 1  # the command that ends with the sample
    rows = (np.moveaxis(np.asarray(x, np.float64), 1, 2) for x in (trace.actuators, trace.command))
    speeds, commands = rows  # (time, runs, 4)
    between = CubicSpline(dt * np.arange(steps), speeds[:steps], axis=0)(times)
    between = between + NOISE[6] * rng.standard_normal(between.shape)
    return np.moveaxis(np.concatenate([between, commands[held]], axis=2), 0, 1).astype(np.float32)


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
    """Estimates (runs, n), rpm, of ``quadjax.vehicle.battery`` in float64, from samples (.., 8)."""
    with enable_x64(True):
        top, lag = (jnp.float64(float(x)) for x in (c.rpm_max, c.tau))
        params = battery.limit_estimator(top, lag, rate)

        def one(
            state: battery.LimitEstimatorState, row: jax.Array
        ) -> tuple[battery.LimitEstimatorState, jax.Array]:
            state = battery.update(params, state, Rotors.of(row[:4]), Rotors.of(row[4:]))
            return state, state.highest

        def run(rows: jax.Array) -> jax.Array:
            begun = battery.begin(params, Rotors.of(rows[0, :4]), jnp.float64(first))
            found = jax.lax.scan(one, begun, rows[1:])[1]
            return jnp.concatenate([begun.highest[None], found])

        return np.asarray(jax.jit(jax.vmap(run))(jnp.asarray(samples, jnp.float64)))
