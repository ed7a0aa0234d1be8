"""A policy fine-tuned on a plant's own numbers: what ``quadjax improve`` could reach at most.

``python -m benchmarks.improve_reference e2e --policy FILE --plant-seed 0 --output runs/ten/0`` adds
``check_N_reference.json`` to the folder of ``quadjax improve`` with the same options; then
``benchmarks.improve_plants`` has the column "reference". The model has the plant's constants and
battery, and a residual that is fitted to flights with exact sensors, without gusts and delays. The
training has the steps of all rounds together. The mean is in docs/design/adaptation.md.
"""

import dataclasses
from pathlib import Path
from typing import Annotated

from quadjax.cli import options, script
from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.files import write_json
from quadjax.fitting.config import load_fit_config
from quadjax.fitting.fit import fit as fit_drone
from quadjax.fitting.flight_log import read_log
from quadjax.fitting.report import write_results
from quadjax.improve import CHECK_SEED, Round, Setting, fly_and_log, fly_checks, tune
from quadjax.plant import config as plants
from quadjax.plant.plant import drawn_factors, nominal_vehicle
from quadjax.refit import Model
from quadjax.vehicle.battery import BatteryConfig
from quadjax.vehicle.vehicle_file import write_vehicle

FLIGHTS, LAPS = 4, 6  # for the residual
NOT_OF_THE_DRONE = ("gusts", "flex", "vibration", "offset")  # effects without a part in a residual


@dataclasses.dataclass(frozen=True)
class PlantModel(Model):
    """Constants, residual and battery of a plant, in place of fitted ones."""

    of_plant: BatteryConfig | None = None

    def limits(self, config: Config) -> BatteryConfig | None:
        """The plant's battery."""
        return self.of_plant


def exact(plant: plants.PlantConfig) -> plants.PlantConfig:
    """The plant with exact sensors, the true state, and without gusts and delays."""
    nothing = {"noise": 0.0, "bias": 0.0, "bias_walk": 0.0, "low_pass": 0.0}
    sensors = plants.SensorsConfig(
        gyro=plants.GyroConfig(**nothing),
        accelerometer=plants.AccelerometerConfig(**nothing),
        rpm=plants.RpmConfig(noise=0.0, resolution=0.0),
    )
    effects = plant.effects.replace(**dict.fromkeys(NOT_OF_THE_DRONE, 0.0))
    still = plants.DelayConfig(command=0.0, measurement=0.0)
    return plant.replace(navigation="ground_truth", sensors=sensors, effects=effects, delay=still)


def plant_model(setting: Setting, folder: Path) -> tuple[PlantModel, list[Path]]:
    """The model of a plant, and the logs that its residual is fitted to."""
    plant, fit, vehicle = setting.plant, setting.fit, folder / "plant.yaml"
    assert plant is not None
    (folder / "logs").mkdir(parents=True, exist_ok=True)
    base, (factors, _) = nominal_vehicle(plant), drawn_factors(plant)
    true = {name: x * factors.get(name, 1.0) for name, x in base.models["motor"].items()}
    drawn = dataclasses.replace(base.with_constants("motor", true), name="plant")
    write_vehicle(vehicle, drawn, "The constants of a drawn stand-in plant.")
    exactly = dataclasses.replace(setting, plant=exact(plant), flights=FLIGHTS, laps=LAPS)
    state = Round(setting.policy, Model.of(setting.race), 0.0)
    flown = fly_and_log(exactly, state, "plant", folder / "logs", CHECK_SEED + 1, print)
    long = [run for run, s in enumerate(flown["seconds"]) if s > fit.logs.min_seconds]
    files = [folder / "logs" / f"plant_{run}.csv" for run in long]
    changed = fit.replace(
        vehicle=str(vehicle.resolve()),
        logs=fit.logs.replace(files=tuple(map(str, files))),
        body=fit.body.replace(rpm_range=(true["rpm_min"], true["rpm_max"])),
        nominal=fit.nominal.replace(fit=False),
    )
    write_results(fit_drone(changed, Path(), print), folder)
    battery = plant.battery if plant.effects.battery > 0 else None
    return PlantModel(true, str(folder / "residual.npz"), of_plant=battery), files


def improve_reference(
    config: options.ConfigName,
    /,
    *,
    policy: options.PolicyFile,
    output: options.Folder,
    plant_seed: options.Seed = 0,
    steps: Annotated[int, options.whole(1, 10**12)] = 3_000_000,
    margin: Annotated[float, options.number(0.0, 10.0)] = 0.0,
) -> None:
    """Fine-tune POLICY with the steps of all rounds together and the last round's margin (m)."""
    race, standin = load_config(config), plants.load_plant_config("standin")
    drone = standin.replace(constants=standin.constants.replace(seed=plant_seed))
    setting = Setting(race, policy, load_fit_config("improve"), drone, steps=steps)
    setting.check_policy()
    folder = output / "reference"
    model, files = plant_model(setting, folder)
    logs = [read_log(file, setting.fit.logs) for file in files]
    tuned = tune(setting, Round(policy, model, margin), logs, folder, print)
    path = output / f"check_{setting.check}_reference.json"
    write_json(path, fly_checks(setting, tuned))


if __name__ == "__main__":
    script(improve_reference)
