"""Consistency of the navigation filter: its errors against its own standard deviations."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from quadjax.config.schema import Config
from quadjax.core.frames import wrap_angle
from quadjax.core.vectors import Rotors, Vec3
from quadjax.plant import plant as physics
from quadjax.plant.config import PlantConfig
from quadjax.plant.ekf import EkfState
from quadjax.plant.ekf_params import EkfParams
from quadjax.plant.estimate import NavigationState, estimate
from quadjax.plant.flight import Flight, FlightParams
from quadjax.plant.flights import fly_chunks
from quadjax.plant.races import plan_race
from quadjax.plant.sensors import GroundTruth, SensorState
from quadjax.policy.file import Policy
from quadjax.vehicle.rate import RateCommand

WITHIN = 3.0  # standard deviations
LEAST_INSIDE = 0.99  # of the samples within three standard deviations
DIVERGED = {"position": 0.5, "euler": 0.5, "velocity": 2.0}  # m, rad, m/s
COMPONENTS = tuple(item.name for item in dataclasses.fields(NavigationState))
UNITS = ("m", "m/s", "rad", "rad/s", "m/s^2", "rad/s", "m/s^2")
MAX_LAPS = 100  # more than any flight completes
POLICIES = ("e2e.npz", "indi.npz")


@dataclasses.dataclass(frozen=True)
class Consistency:
    """Result; arrays are (7, 3): components of ``NavigationState`` by axes."""

    flights: int
    completed: int  # flights without a crash
    hours: float  # of flight
    inside: np.ndarray  # fraction of the samples within three standard deviations
    rmse: np.ndarray
    ratio: np.ndarray  # mean of (error / standard deviation)^2; 1 for a consistent filter
    worst: np.ndarray  # largest error over its standard deviation
    diverged: int  # flights

    @property
    def passed(self) -> bool:
        """Whether no flight diverged and every component is inside often enough."""
        return self.diverged == 0 and bool((self.inside >= LEAST_INSIDE).all())

    def to_json(self) -> dict[str, object]:
        """Plain values."""
        values = vars(self) | {"passed": self.passed}
        return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}


def errors_and_deviations(
    params: EkfParams, filtered: EkfState, truth: GroundTruth, sensors: SensorState
) -> jax.Array:
    """Errors and standard deviations (2, 7, 3) of the present estimate of one drone."""
    now = estimate(params, filtered)
    true = (
        *(getattr(truth, name) for name in COMPONENTS[:5]),
        sensors.gyro.bias,
        sensors.accelerometer.bias,
    )
    errors = [getattr(now.value, n) - t for n, t in zip(COMPONENTS, true, strict=True)]
    errors[2] = Vec3(*(wrap_angle(angle) for angle in errors[2].components()))
    deviations = [getattr(now.std, name) for name in COMPONENTS]
    return jnp.stack([jnp.stack([v.array() for v in part]) for part in (errors, deviations)])


def _record(
    params: FlightParams, flight: Flight, command: Rotors | RateCommand, rotors: Rotors
) -> tuple[jax.Array, jax.Array]:
    truth = physics.truth_of(params.plant, flight.plant)
    onboard = flight.onboard
    numbers = errors_and_deviations(params.onboard.ekf, onboard.ekf, truth, onboard.sensors)
    return numbers, flight.race.over


def evaluate_filter(
    race: Config,
    plant: PlantConfig,
    policy: Path,
    flights: int,
    seconds: float,
    seed: int = 0,
    report: Callable[[float], None] = lambda seconds: None,
) -> Consistency:
    """Simulate a policy and compare every estimate with the true state.

    Args:
        race: config of the race.
        plant: config of the plant.
        policy: policy file.
        flights: number of drones.
        seconds: of each flight.
        seed: of batteries, gusts, sensors and the policy's noise.
        report: called with the simulated seconds.
    """
    plant = plant.replace(control_rate=plant.sample_rate, navigation="ekf")
    plan = plan_race(
        race,
        plant,
        Policy.load(policy),
        str(policy),
        lap_count=MAX_LAPS,
        runs=flights,
        recorded=flights,
        deterministic=False,
    )
    plan = dataclasses.replace(plan, limit=round(seconds * plant.sample_rate))
    total, worst, diverged = np.zeros((3, 7, 3)), np.zeros((7, 3)), np.zeros(flights, bool)
    samples, seconds_simulated = 0, 0.0
    for drones, (numbers, over) in fly_chunks(plan, seed, _record):
        numbers = np.where(over[:, None, None, None], 0.0, numbers)  # (time, 2, 7, 3, flights)
        error, ratio = np.abs(numbers[:, 0]), tally_ratio(numbers)
        total += [part.sum(axis=(0, -1)) for part in ((ratio <= WITHIN), error**2, ratio**2)]
        total[0] -= over.sum()
        worst = np.maximum(worst, ratio.max(axis=(0, -1)))
        diverged |= diverged_flights(error)
        samples += int((~over).sum())
        seconds_simulated += len(over) / plant.sample_rate
        crashed = np.asarray(drones.race.crash) > 0
        report(seconds_simulated)
    return Consistency(
        flights=flights,
        completed=int((~crashed).sum()),
        hours=samples / plant.sample_rate / 3600.0,
        inside=total[0] / samples,
        rmse=np.sqrt(total[1] / samples),
        ratio=total[2] / samples,
        worst=worst,
        diverged=int(diverged.sum()),
    )


def tally_ratio(numbers: np.ndarray) -> np.ndarray:
    """Absolute error over standard deviation, of (.., 2, 7, 3, n): (.., 7, 3, n)."""
    return np.abs(numbers[..., 0, :, :, :]) / np.maximum(numbers[..., 1, :, :, :], 1e-12)


def diverged_flights(error: np.ndarray) -> np.ndarray:
    """Flights (n,) with a large or non-finite error in (time, 7, 3, n)."""
    sizes = {name: np.linalg.norm(error[:, COMPONENTS.index(name)], axis=1) for name in DIVERGED}
    return ~np.all([sizes[name] <= limit for name, limit in DIVERGED.items()], axis=(0, 1))


def table(name: str, result: Consistency) -> str:
    """The result as text."""
    lines = [
        f"{name}: {result.flights} flights, {result.hours:.2f} h, {result.completed} completed, "
        f"{result.diverged} diverged",
        f"{'':>19} {'RMS error':>32} {'':7}{'inside 3 sigma, %':>22} {'mean (e/sigma)^2':>20}",
    ]
    for index, (component, unit) in enumerate(zip(COMPONENTS, UNITS, strict=True)):
        errors = "".join(f"{x:>10.5f}" for x in result.rmse[index])
        inside = "".join(f"{np.floor(1e4 * x) / 100:>8.2f}" for x in result.inside[index])
        ratio = "".join(f"{x:>7.2f}" for x in result.ratio[index])
        lines.append(f"{component:>19} {errors} {unit:<7}{inside} {ratio}")
    verdict = "passed" if result.passed else "failed"
    return "\n".join([*lines, f"{verdict}: 99% inside, none diverged"])
