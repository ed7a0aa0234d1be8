"""The same policy, fine-tuned on the plant's own numbers: what learning from flights could reach.

It is for comparison. No round of learning uses anything of it.
"""

import dataclasses
from pathlib import Path

from quadjax.config.schema import Config
from quadjax.fitting.config import FitConfig
from quadjax.fitting.pipeline import Report, run_fit
from quadjax.fitting.report import write_results
from quadjax.plant.build import drawn_factors, nominal_vehicle
from quadjax.plant.config import (
    AccelerometerConfig,
    DelayConfig,
    GyroConfig,
    PlantConfig,
    RpmConfig,
    SensorsConfig,
)
from quadjax.studies.improve.flights import Flown, fly_and_log
from quadjax.studies.improve.model import Model
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.constants import constant_names
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.vehicle_file import write_vehicle

FLIGHTS = 4  # for the residual
LAPS = 6
NAME = "plant"
NOT_OF_THE_DRONE = ("gusts", "flex", "vibration", "offset")  # effects without a part in a residual


@dataclasses.dataclass(frozen=True)
class PlantModel(Model):
    """Constants, residual and battery of a plant.

    Attributes:
        own: the battery; None without one.
        logs: files of the flights that the residual is fitted to.
    """

    own: BatteryConfig | None = None
    logs: tuple[Path, ...] = ()

    def limits(self, config: Config) -> BatteryConfig | None:
        """The plant's battery."""
        return self.own


def plant_model(
    config: Config,
    plant: PlantConfig,
    policy: Path,
    fit: FitConfig,
    folder: Path,
    seed: int,
    report: Report,
) -> PlantModel:
    """The model of a plant: its constants and battery, and a residual of its other forces.

    The residual is fitted to the difference between the plant's forces and moments and those of a
    drone with its constants, on flights with exact sensors and without gusts and delays.

    Args:
        config: of the race.
        plant: of the plant.
        policy: file of the policy that flies.
        fit: config of the fit; its constants are not fitted.
        folder: for logs, vehicle file and residual.
        seed: of the flights' batteries.
        report: called with the progress.
    """
    logs, vehicle = folder / "logs", folder / "plant.yaml"
    logs.mkdir(parents=True, exist_ok=True)
    base, (factors, _) = nominal_vehicle(plant), drawn_factors(plant)
    names = constant_names(MotorConstants)
    own = {name: float(getattr(base.motor, name)) * factors.get(name, 1.0) for name in names}
    true = dataclasses.replace(base, name="plant").with_constants("motor", own)
    write_vehicle(vehicle, true, "The constants of a drawn stand-in plant.")
    flights, residual = folder / "flights.json", folder / "residual.npz"
    if not flights.exists():
        options = (NAME, logs, FLIGHTS, LAPS, seed, report)
        fly_and_log(config, exact(plant), policy, *options).save(flights)
    files = tuple(
        logs / f"{NAME}_{run}.csv"
        for run, seconds in enumerate(Flown.load(flights).seconds)
        if seconds > fit.logs.min_seconds
    )
    if not residual.exists():
        ends = (own["rpm_min"], own["rpm_max"])
        changed = fit.replace(
            vehicle=str(vehicle.resolve()),
            logs=fit.logs.replace(files=tuple(map(str, files))),
            body=fit.body.replace(rpm_range=ends),
            nominal=fit.nominal.replace(fit=False),
        )
        write_results(run_fit(changed, Path(), report), folder)
    return PlantModel(own, str(residual), own=_battery(plant), logs=files)


def _battery(plant: PlantConfig) -> BatteryConfig | None:
    return plant.battery if plant.effects.battery > 0 else None


def exact(plant: PlantConfig) -> PlantConfig:
    """The plant with exact sensors, the true state, and without gusts and delays."""
    nothing = {"noise": 0.0, "bias": 0.0, "bias_walk": 0.0, "low_pass": 0.0}
    sensors = SensorsConfig(
        gyro=GyroConfig(**nothing),
        accelerometer=AccelerometerConfig(**nothing),
        rpm=RpmConfig(noise=0.0, resolution=0.0),
    )
    effects = plant.effects.replace(**dict.fromkeys(NOT_OF_THE_DRONE, 0.0))
    still = DelayConfig(command=0.0, measurement=0.0)
    return plant.replace(navigation="ground_truth", sensors=sensors, effects=effects, delay=still)
