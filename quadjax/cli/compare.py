"""``quadjax compare``."""

import time
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.core.files import write_json, write_text
from quadjax.core.folders import results
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED

FILES = ("table.txt", "compare.json", "compare.png", "config.yaml")
Policies = Annotated[
    tuple[opt.PolicyFile, ...],
    opt.LIST,
    Parameter(metavar="FILE ...", show_default=lambda files: files[0].stem),
]


def compare(
    plant: Annotated[opt.PlantConfig | None, Parameter(name="PLANT")] = None,
    /,
    *overrides: opt.Overrides,
    e2e: Policies = (PRETRAINED / "e2e_cyberzoo.npz",),
    indi: Policies = (PRETRAINED / "indi_cyberzoo.npz",),
    race: opt.Race = None,
    conditions: opt.Conditions = None,
    only: opt.Labels = None,
    drones: opt.Drones | None = None,
    laps: opt.Laps = 6,
    runs: opt.Runs = 100,
    deterministic: opt.Flag = False,
    failed_after: Annotated[float | None, opt.number(0.01, 1e4)] = None,
    seed: opt.Seed = 0,
    name: opt.RunName = "compare",
    output: opt.RunsFolder = Path("runs"),
    overwrite: opt.Overwrite = False,
) -> None:
    """Compare E2E and INDI in the simulator and on a plant.

    Prints laps, totals and scores, and by how much E2E is faster, with 95% intervals
    over drones, trainings and flights. Without PLANT both fly in the simulator only.
    DIR/NAME gets table.txt, compare.json, compare.png and, with a plant, its
    config.yaml. Overrides change the plant's config.

    Example: quadjax compare cyberzoo --drones 20 --runs 100

    Args:
        e2e: Policies that command the motors; several are trainings with different seeds.
        indi: Policies that command thrust and rates.
        race: Preset or YAML file of the race of both, whose vehicle is the model on board
            (default: for each policy the race that it was trained in, which must have the same
            track and rules).
        drones: Number of drones of the plant, which share the runs (default: as many of its
            population as share them equally).
        laps: Laps of a run.
        runs: Number of runs of each policy.
        deterministic: Mean actions only.
        failed_after: Total that a flight that does not finish has in the score, s (default: twice
            the mean total of the flights that finish).
        seed: Seed of noise, batteries, gusts and sensors.
    """
    opt.check_shares(runs, drones)
    if conditions is None:
        opt.refuse("without --conditions", only=only)
    with loading():
        from quadjax.core.plotting import save_figure
        from quadjax.core.yaml_files import to_yaml
        from quadjax.evaluation.compare import compare as fly
        from quadjax.evaluation.conditions import read_conditions
        from quadjax.plant.config import load_plant_config

    started, folder = time.monotonic(), output / name
    drone = None if plant is None else load_plant_config(plant, overrides)
    how: dict[str, Any] = {"plant": drone, "drones": drones, "runs": runs, "laps": laps}
    how |= {"seed": seed, "race": race, "failed_after": failed_after}
    how["deterministic"] = deterministic or None
    how["conditions"] = None if conditions is None else read_conditions(conditions, only)
    with results(folder, "comparison", FILES, overwrite) as new, steps() as report:
        duel = fly(e2e, indi, **how, progress=report)
        text = f"{duel.table()}\n\n{duel.lead()}"
        write_text(new / "table.txt", text + "\n")
        write_json(new / "compare.json", duel.to_json())
        save_figure(duel.plot(), new / "compare.png")
        if drone is not None:
            write_text(new / "config.yaml", to_yaml(drone.model_dump()))
    print(text)
    wrote(f"{folder}/ in {time.monotonic() - started:.0f} s")
