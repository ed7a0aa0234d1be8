"""Consistency of the navigation filter: its errors against its standard deviations.

Flights on the plant without unmodeled effects and delays. The filter fails (exit status 1) where a
component is within three standard deviations less than 99% of the time, or where an estimate is
0.5 m, 0.5 rad or 2 m/s off. ``python -m benchmarks.consistency``; table: docs/design/plant.md.
"""

import dataclasses
import sys
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.loading import load_config
from quadjax.core.frames import wrap_angle
from quadjax.core.resources import PRETRAINED
from quadjax.core.vectors import Vec3
from quadjax.plant import plant as physics
from quadjax.plant.config import PlantConfig, load_plant_config, without_effects
from quadjax.plant.estimate import NavigationState, estimate
from quadjax.plant.flights import fly_chunks
from quadjax.plant.races import plan_race
from quadjax.policy.file import Policy

COMPONENTS = tuple(item.name for item in dataclasses.fields(NavigationState))
UNITS = ("m", "m/s", "rad", "rad/s", "m/s^2", "rad/s", "m/s^2")  # of them
LEAST_INSIDE = 0.99  # of the samples within three standard deviations
DIVERGED = {"position": 0.5, "euler": 0.5, "velocity": 2.0}  # m, rad, m/s


class Consistency(NamedTuple):
    """Arrays are (7, 3): components of ``NavigationState`` by axes."""

    samples: int
    diverged: int
    inside: np.ndarray  # fraction of the samples within three standard deviations
    rmse: np.ndarray
    ratio: np.ndarray  # mean of (error / standard deviation)^2; 1 for a consistent filter


def errors_and_deviations(params, filtered, truth, sensors) -> jax.Array:
    """Errors and standard deviations (2, 7, 3) of the present estimate of one drone."""
    now, biases = estimate(params, filtered), (sensors.gyro.bias, sensors.accelerometer.bias)
    true = (*(getattr(truth, name) for name in COMPONENTS[:5]), *biases)
    errors = [getattr(now.value, name) - x for name, x in zip(COMPONENTS, true, strict=True)]
    errors[2] = Vec3(*(wrap_angle(angle) for angle in errors[2].components()))
    deviations = [getattr(now.std, name) for name in COMPONENTS]
    return jnp.stack([jnp.stack([v.array() for v in rows]) for rows in (errors, deviations)])


def errors_in_deviations(numbers: np.ndarray) -> np.ndarray:
    """Absolute error over standard deviation (.., 7, 3, n), of (.., 2, 7, 3, n)."""
    return np.abs(numbers[..., 0, :, :, :]) / np.maximum(numbers[..., 1, :, :, :], 1e-12)


def _record(params, flight, command, rotors):
    truth, onboard = physics.truth_of(params.plant, flight.plant), flight.onboard
    numbers = errors_and_deviations(params.onboard.ekf, onboard.ekf, truth, onboard.sensors)
    return numbers, flight.race.over


def evaluate_filter(plant: PlantConfig, policy: Path, runs: int, seconds: float) -> Consistency:
    """Compare every estimate of ``runs`` flights of a policy with the true state."""
    plant = plant.replace(control_rate=plant.sample_rate, navigation="ekf")
    options = {"lap_count": 100, "runs": runs, "recorded": runs, "deterministic": False}
    race = load_config("e2e +residual")
    plan = plan_race(race, plant, Policy.load(policy), str(policy), **options)
    plan = dataclasses.replace(plan, limit=round(seconds * plant.sample_rate))
    total, diverged, samples = np.zeros((3, 7, 3)), np.zeros(runs, bool), 0
    for _, (numbers, over) in fly_chunks(plan, 0, _record):
        numbers = np.where(over[:, None, None, None], 0.0, numbers)  # (time, 2, 7, 3, flights)
        error, ratio = np.abs(numbers[:, 0]), errors_in_deviations(numbers)
        total += [x.sum(axis=(0, -1)) for x in (ratio <= 3.0, error**2, ratio**2)]
        total[0] -= over.sum()
        for name, limit in DIVERGED.items():
            size = np.linalg.norm(error[:, COMPONENTS.index(name)], axis=1)
            diverged |= ~(size <= limit).all(axis=0)
        samples += int((~over).sum())
    inside, square, ratio = total / samples
    return Consistency(samples, int(diverged.sum()), inside, np.sqrt(square), ratio)


def main() -> int:
    """Print the table of each policy."""
    runs, passed, plant = 1000, True, without_effects(load_plant_config("standin"))
    for name in ("e2e", "indi"):
        result = evaluate_filter(plant, PRETRAINED / f"{name}.npz", runs, 20.0)
        print(f"{name}: {result.samples} samples, {result.diverged} of {runs} flights diverged")
        print("RMS error, inside 3 sigma in %, mean (error / sigma)^2, of three axes each")
        for row in zip(COMPONENTS, UNITS, result.rmse, 100 * result.inside, result.ratio):
            print(f"{row[0]:>19} {row[1]:6}", *(f"{x:9.5g}" for x in np.concatenate(row[2:])))
        passed &= result.diverged == 0 and bool((result.inside >= LEAST_INSIDE).all())
    return int(not passed)


if __name__ == "__main__":
    sys.exit(main())
