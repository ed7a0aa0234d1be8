"""Flight logs of a simulated drone, with sensor noise, in the columns of a Paparazzi log.

To try the fit on a drone whose every constant is known. The drone follows wandering attitudes and
climbs under a simple controller; commands are held between samples and the motion between them is
integrated by Runge-Kutta, so the logs are those of a continuous flight. As a command::

    python -m quadjax.fitting.synthetic_log --flights 4 --out logs
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.cli.arguments import Parser, check_writable, count, parse, seed
from quadjax.core.errors import InputError, command_line
from quadjax.core.files import whole_file
from quadjax.core.frames import attitude, world_to_body
from quadjax.core.integrators import rk4_step
from quadjax.core.vectors import Rotors, Vec3
from quadjax.fitting.columns import paparazzi_columns
from quadjax.fitting.vehicle_file import read_vehicle
from quadjax.vehicle import motor
from quadjax.vehicle.motor import MotorState
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import residual_force_moment
from quadjax.vehicle.residual_file import read_residual

SUBSTEPS = 2


@dataclass(frozen=True)
class SensorNoise:
    """Standard deviations of white noise at the log's rate."""

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
        seed: decides the flight and the noise.
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
            "rpm": noisy(states.rpm, noise.rpm),
            "rpm_command": noisy(commands, 0.0),
            "acceleration": noisy(forces, noise.acceleration) + bias,
            "acceleration_bias": bias,
        }
    )


def write_log(path: Path | str, columns: dict[str, np.ndarray]) -> None:
    """Write columns as a CSV flight log, whole."""
    with whole_file(path) as temporary:
        table = np.stack(list(columns.values()), axis=1)
        header = ",".join(columns)
        np.savetxt(temporary, table, fmt="%.8g", delimiter=",", header=header, comments="")


def _wandering(random: np.random.Generator, count: int, sample_rate: float) -> np.ndarray:
    """Targets (n, 4) for roll, pitch, yaw, rad, and climb, m/s: a few sines each."""
    time = np.arange(count)[:, None] / sample_rate
    size = np.array([0.5, 0.5, 0.7, 1.5])
    targets = np.zeros((count, 4))
    for low, high, share in ((0.15, 0.5, 0.7), (0.5, 1.2, 0.5), (1.2, 2.5, 0.3)):
        frequency = random.uniform(low, high, 4)
        phase = random.uniform(0.0, 2.0 * np.pi, 4)
        targets += share * size * np.sin(2.0 * np.pi * frequency * time + phase)
    # Long turns to either side: yaw damping shows in them alone.
    swing = random.uniform(0.03, 0.06)
    targets[:, 2] += 4.0 / swing / 10.0 * np.sin(2.0 * np.pi * swing * time[:, 0])
    return targets


@partial(jax.jit, static_argnums=2)
def _fly(
    vehicle: VehicleParams, targets: jax.Array, sample_rate: float
) -> tuple[MotorState, Rotors, Vec3]:
    """States, rpm commands and specific forces, n of each, of a flight after the targets."""
    dt = 1.0 / (sample_rate * SUBSTEPS)

    def step(
        state: MotorState, target: jax.Array
    ) -> tuple[MotorState, tuple[MotorState, Rotors, Vec3]]:
        command = _control(vehicle, state, target)
        body_velocity = world_to_body(attitude(state.euler), state.velocity)
        steady = Rotors.same(jnp.zeros(()))
        force, _ = motor.force_moment(vehicle, state.rpm, steady, body_velocity, state.rates)
        seen = (state, command, force)
        state = jax.lax.fori_loop(
            0,
            SUBSTEPS,
            lambda _, s: rk4_step(lambda x: motor.derivative(vehicle, x, command), s, dt),
            state,
        )
        return state, seen

    rpm = Rotors.same(motor.hover_rpm(vehicle.constants))
    start = MotorState(*(Vec3.zero() for _ in range(4)), rpm, Vec3.zero(), Vec3.zero())
    return jax.lax.scan(step, start, targets)[1]


def _control(vehicle: VehicleParams, state: MotorState, target: jax.Array) -> Rotors:
    """Rpm commands that turn towards target angles and hold a target climb rate."""
    c = vehicle.constants
    hover = motor.hover_rpm(c)
    # Angular acceleration per rpm of difference, about hover, from the nominal model.
    effect = Vec3(8.0 * c.k_p * hover / c.i_xx, 8.0 * c.k_q * hover / c.i_yy, 4.0 * c.k_r1 / c.i_zz)
    angle = Vec3.of(target[:3]) - state.euler
    wanted = angle * Vec3(60.0, 60.0, 6.0) - state.rates * Vec3(12.0, 12.0, 4.0)
    if vehicle.residual is not None:  # an ideal pilot: it knows what it has to work against
        body_velocity = world_to_body(attitude(state.euler), state.velocity)
        _, extra = residual_force_moment(vehicle.residual, state.rpm, body_velocity, state.rates)
        wanted = wanted - extra / Vec3(c.i_xx, c.i_yy, c.i_zz)
    turn = wanted / effect
    roll, pitch, yaw = (jnp.clip(part, -1200.0, 1200.0) for part in turn.components())
    tilt = jnp.clip(jnp.cos(state.euler.x) * jnp.cos(state.euler.y), 0.5, 1.0)
    lift = hover / jnp.sqrt(tilt) + 400.0 * (target[3] + state.velocity.z)  # z down
    mix = (roll + pitch - yaw, -roll + pitch + yaw, -roll - pitch - yaw, roll - pitch + yaw)
    return Rotors(*(jnp.clip(lift + part, c.rpm_min, c.rpm_max) for part in mix))


def main() -> None:
    """Write flight logs of a simulated drone."""
    parser = Parser(description=main.__doc__)
    parser.add_argument("--vehicle", default="bebop1.yaml", help="a file of configs/vehicles")
    parser.add_argument("--residual", type=Path, help="a residual file (.npz)")
    parser.add_argument("--flights", type=count, default=4)
    parser.add_argument("--seconds", type=float, default=30.0, help="of each flight")
    parser.add_argument("--seed", type=seed, default=0, help="of the first flight")
    parser.add_argument("--out", type=Path, required=True, help="the folder to write to")
    words = parse(parser)
    if not 1.0 <= words.seconds <= 3600.0:
        raise InputError(f"--seconds is {words.seconds}, expected 1 to 3600")
    check_writable(words.out / "flight_0.csv")
    residual = read_residual(words.residual) if words.residual else None
    vehicle = VehicleParams(read_vehicle(words.vehicle, Path()).motor, residual)
    for index in range(words.flights):
        columns = simulate_flight(vehicle, words.seed + index, words.seconds)
        if not all(np.isfinite(values).all() for values in columns.values()):
            raise InputError(
                f"flight {index} with seed {words.seed + index} got out of control; is the "
                "residual stronger than the motors?"
            )
        path = words.out / f"flight_{index}.csv"
        write_log(path, columns)
        print(f"wrote {path}")


if __name__ == "__main__":
    command_line(main)()
