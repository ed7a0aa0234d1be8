"""Simulated flight logs and random residual networks, to test a fit against a known model.

The drone follows wandering attitudes and climbs under a simple controller. Commands are held
between samples and the motion in between is integrated by Runge-Kutta steps, so the logs are those
of a continuous flight.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.frames import attitude, world_to_body
from quadjax.core.integrators import rk4_step
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.flight_log import write_log
from quadjax.fitting.formats import paparazzi_columns
from quadjax.vehicle import motor
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import Layers, Residual, residual_force_moment
from quadjax.vehicle.rigid_body import BodyState, RigidBodyState

SUBSTEPS = 2
# The flight envelope of the Bebop 1 for random residuals.
RPM_RANGE = (3000.0, 11000.0)
ENVELOPE = np.array([1.0] * 4 + [8.0] * 3 + [6.0] * 3)  # scaled rpm, m/s, rad/s, both signs
SAMPLES = 20_000


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of white noise at the sample rate of the log."""

    rpm: float = 20.0  # rpm
    gyro: float = 0.01  # rad/s
    acceleration: float = 0.2  # m/s^2
    velocity: float = 0.02  # m/s
    angle: float = 0.002  # rad


def simulate_flight(
    vehicle: VehicleParams,
    seed: int,
    seconds: float = 30.0,
    sample_rate: float = 500.0,
    noise: SensorNoise | None = None,
) -> dict[str, np.ndarray]:
    """One flight as the columns of a Paparazzi log, each (n,).

    Args:
        vehicle: constants, and residual if any.
        seed: of the flight and the noise.
        seconds: length, s.
        sample_rate: of the log, Hz.
        noise: of the sensors.
    """
    noise = noise or SensorNoise()
    random = np.random.default_rng(seed)
    count = int(seconds * sample_rate)
    targets = _wandering(random, count, sample_rate)
    states, commands, forces = _fly(vehicle, jnp.asarray(targets, jnp.float32), sample_rate)

    def noisy(values: Vec3 | Rotors, size: float) -> np.ndarray:
        exact = np.asarray(values.array(), np.float64)
        return exact + size * random.normal(size=exact.shape)

    bias = np.broadcast_to(random.normal(scale=0.1, size=3), (count, 3))
    return paparazzi_columns(
        {
            "time": np.arange(count) / sample_rate,
            "mode": np.ones(count),
            "position": noisy(states.position, 0.0),
            "world_velocity": noisy(states.velocity, noise.velocity),
            "euler": noisy(states.euler, noise.angle),
            "gyro": noisy(states.rates, noise.gyro),
            "rpm": noisy(states.actuators, noise.rpm),
            "rpm_command": noisy(commands, 0.0),
            "acceleration": noisy(forces, noise.acceleration) + bias,
            "acceleration_bias": bias,
        }
    )


def write_flights(
    vehicle: VehicleParams,
    folder: Path,
    flights: int,
    seconds: float,
    seed: int,
    report: Callable[[str], object] = lambda line: None,
) -> list[Path]:
    """Simulate flights and write each one's log to ``folder/flight_RUN.csv``.

    Args:
        vehicle: constants, and residual if any.
        folder: of the logs.
        flights: number of flights.
        seconds: of each flight.
        seed: of the first flight; the others have those that follow.
        report: called with the progress.

    Raises:
        InputError: a flight that is not finite.
    """
    paths = []
    for index in range(flights):
        report(f"flight {index + 1} of {flights}")
        columns = simulate_flight(vehicle, seed + index, seconds)
        if not all(np.isfinite(values).all() for values in columns.values()):
            raise InputError(
                f"flight {index} with seed {seed + index} is not finite; is the residual too "
                "strong for the motors?"
            )
        paths.append(folder / f"flight_{index}.csv")
        write_log(paths[-1], columns)
    return paths


def _wandering(random: np.random.Generator, count: int, sample_rate: float) -> np.ndarray:
    """Targets (n, 4) for roll, pitch, yaw, rad, and climb, m/s: a few sines each."""
    time = np.arange(count)[:, None] / sample_rate
    size = np.array([0.5, 0.5, 0.7, 1.5])
    targets = np.zeros((count, 4))
    for low, high, weight in ((0.15, 0.5, 0.7), (0.5, 1.2, 0.5), (1.2, 2.5, 0.3)):
        frequency = random.uniform(low, high, 4)
        phase = random.uniform(0.0, 2.0 * np.pi, 4)
        targets += weight * size * np.sin(2.0 * np.pi * frequency * time + phase)
    # Long turns to either side; only these excite yaw damping.
    swing = random.uniform(0.03, 0.06)
    targets[:, 2] += 4.0 / swing / 10.0 * np.sin(2.0 * np.pi * swing * time[:, 0])
    return targets


@partial(jax.jit, static_argnums=2)
def _fly(
    vehicle: VehicleParams, targets: jax.Array, sample_rate: float
) -> tuple[RigidBodyState, Rotors, Vec3]:
    """States, rpm commands and specific forces, n of each, of a flight that follows targets."""
    dt = 1.0 / (sample_rate * SUBSTEPS)

    def step(
        state: RigidBodyState, target: jax.Array
    ) -> tuple[RigidBodyState, tuple[RigidBodyState, Rotors, Vec3]]:
        command = _control(vehicle, state, target)
        body_velocity = world_to_body(attitude(state.euler), state.velocity)
        steady = BodyState.steady(body_velocity, state.rates, state.actuators)
        force, _ = motor.MODEL.force_moment(vehicle, steady)
        record = (state, command, force)
        state = jax.lax.fori_loop(
            0,
            SUBSTEPS,
            lambda _, s: rk4_step(lambda x: motor.MODEL.derivative(vehicle, x, command), s, dt),
            state,
        )
        return state, record

    rpm = Rotors.same(motor.hover_rpm(vehicle.constants))
    zero = Vec3.zero()
    start = RigidBodyState(zero, zero, zero, zero, rpm, zero, zero)
    return jax.lax.scan(step, start, targets)[1]


def _control(vehicle: VehicleParams, state: RigidBodyState, target: jax.Array) -> Rotors:
    """Rpm commands that follow target angles and a target climb rate."""
    c = vehicle.constants
    hover = motor.hover_rpm(c)
    # Angular acceleration per rpm of difference, about hover, from the nominal model.
    effect = Vec3(8.0 * c.k_p * hover / c.i_xx, 8.0 * c.k_q * hover / c.i_yy, 4.0 * c.k_r1 / c.i_zz)
    assert isinstance(state.euler, Vec3)
    angle = Vec3.of(target[:3]) - state.euler
    gains, damping = (Vec3.of(jnp.array(x)) for x in ((60.0, 60.0, 6.0), (12.0, 12.0, 4.0)))
    wanted = angle * gains - state.rates * damping
    if vehicle.residual is not None:  # compensated exactly
        body_velocity = world_to_body(attitude(state.euler), state.velocity)
        _, extra = residual_force_moment(
            vehicle.residual, state.actuators, body_velocity, state.rates
        )
        wanted = wanted - extra / Vec3(c.i_xx, c.i_yy, c.i_zz)
    turn = wanted / effect
    roll, pitch, yaw = (jnp.clip(part, -1200.0, 1200.0) for part in turn.components())
    tilt = jnp.clip(jnp.cos(state.euler.x) * jnp.cos(state.euler.y), 0.5, 1.0)
    lift = hover / jnp.sqrt(tilt) + 400.0 * (target[3] + state.velocity.z)  # z down
    mix = (roll + pitch - yaw, -roll + pitch + yaw, -roll - pitch - yaw, roll - pitch + yaw)
    return Rotors(*(jnp.clip(lift + part, c.rpm_min, c.rpm_max) for part in mix))


def random_residual(
    seed: int,
    thrust_std: float = 1.0,
    moment_std: float | tuple[float, float, float] = 0.015,
    width: int = 32,
) -> Residual:
    """A random residual of a given size.

    Args:
        seed: of the weights.
        thrust_std: standard deviation of the body-z specific force over the envelope, m/s^2.
        moment_std: standard deviation of the moments over the envelope, N m; one number for all
            axes or one for each.
        width: hidden units of each network.

    Returns:
        The residual; the mean of each output over the envelope is zero.

    Raises:
        InputError: a standard deviation that is negative or not finite, or a width below one.
    """
    moments = np.broadcast_to(np.asarray(moment_std, np.float64), 3)
    for name, value in (("thrust_std", thrust_std), *(("moment_std", m) for m in moments)):
        if not (np.isfinite(value) and value >= 0.0):
            raise InputError(f"{name} is {value}, expected a finite number that is not negative")
    if width < 1:
        raise InputError(f"width is {width}, expected at least 1")
    random = np.random.default_rng(seed)
    return Residual(
        thrust=_random_network(random, ENVELOPE[:7], width, np.array([thrust_std])),
        moment=_random_network(random, ENVELOPE, width, moments),
        rpm_min=jnp.float32(RPM_RANGE[0]),
        rpm_max=jnp.float32(RPM_RANGE[1]),
        thrust_sign=jnp.float32(1.0),
    )


def _random_network(
    random: np.random.Generator, spans: np.ndarray, width: int, spread: np.ndarray
) -> Layers:
    """A one-hidden-layer network on inputs within +-spans, its outputs scaled to ``spread``."""
    kernel = random.normal(size=(len(spans), width)) / np.sqrt(len(spans))
    bias = random.uniform(-1.0, 1.0, size=width)
    inputs = random.uniform(-1.0, 1.0, size=(SAMPLES, len(spans)))
    hidden = np.maximum(inputs @ kernel + bias, 0.0)
    last = random.normal(size=(width, len(spread)))
    last = last * spread / np.maximum((hidden @ last).std(axis=0), 1e-12)
    layers = ((kernel / spans[:, None], bias), (last, -(hidden @ last).mean(axis=0)))
    return jax.tree.map(lambda values: jnp.asarray(values, jnp.float32), layers)
