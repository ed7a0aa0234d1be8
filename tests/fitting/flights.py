"""Simulated flights of one length and rate: one compiled program, whatever the drone."""

import dataclasses
import functools

import numpy as np

from quadjax.core.resources import CONFIGS
from quadjax.fitting.flight_log import write_log
from quadjax.fitting.simulate import SensorNoise, random_residual, simulate_flight
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.vehicle_file import read_vehicle

SECONDS, RATE = 8.0, 250.0
NOISE = SensorNoise(*(np.sqrt(0.5) * x for x in dataclasses.astuple(SensorNoise())))
BEBOP = str(CONFIGS / "vehicles" / "bebop1.yaml")


@functools.cache
def simulated(seed, residual=(0, 0.0, 0.0), noise=NOISE, **factors) -> dict[str, np.ndarray]:
    """The columns, each (2000,), of a flight of a Bebop with scaled constants; not to be changed.

    Args:
        seed: of the flight and the noise.
        residual: arguments of ``random_residual``; one of zeros is the nominal model.
        noise: of the sensors, by default of the density of the package's default at 500 Hz.
        factors: of constants, by name.
    """
    motor = read_vehicle(BEBOP).motor
    motor = motor.replace(**{name: x * getattr(motor, name) for name, x in factors.items()})
    drone = VehicleParams(motor, random_residual(*residual))
    return simulate_flight(drone, seed, SECONDS, RATE, noise)


def first_seconds(columns: dict[str, np.ndarray], seconds: float) -> dict[str, np.ndarray]:
    """The beginning of a flight."""
    return {name: values[: round(seconds * RATE)] for name, values in columns.items()}


def write_flights(folder, count: int, **options) -> list:
    """Logs ``flight_0.csv`` and so on of ``simulated`` flights."""
    paths = [folder / f"flight_{seed}.csv" for seed in range(count)]
    for seed, path in enumerate(paths):
        write_log(path, simulated(seed, **options))
    return paths
