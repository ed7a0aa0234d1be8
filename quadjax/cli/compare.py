"""``quadjax compare``."""

import time
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.core.folders import results
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED

Part = Literal["table", "plants"]
ShippedPolicy = Annotated[opt.PolicyFile, Parameter(show_default=lambda path: path.stem)]


def compare(
    config: Annotated[str, Parameter(name="CONFIG"), opt.config_of("plant")],
    /,
    *overrides: opt.Overrides,
    e2e: ShippedPolicy = PRETRAINED / "e2e.npz",
    indi: ShippedPolicy = PRETRAINED / "indi.npz",
    race: opt.Race = None,
    parts: Annotated[list[Part] | None, opt.LIST] = None,
    conditions: Annotated[list[str] | None, opt.LIST, Parameter(metavar="NAME ...")] = None,
    drones: opt.Drones = 10,
    laps: opt.Laps = 6,
    runs: opt.Runs = 100,
    sampled: opt.Flag = False,
    seed: opt.Seed = 0,
    name: opt.RunName = "compare",
    output: opt.RunsFolder = Path("runs"),
    overwrite: opt.Overwrite = False,
) -> None:
    """Compare E2E and INDI in the simulator and on the stand-in plant.

    DIR/NAME gets table.txt, compare.json, config.yaml and figures. Overrides change
    the plant's config. The part plants flies both on drawn drones, without each
    effect in turn, with each alone, and with several charges of the battery.

    Example: quadjax compare standin --parts table --runs 100

    Args:
        e2e: The policy that commands the motors. Neither default is fitted to the plant.
        indi: The policy that commands thrust and rates.
        race: Preset or YAML file of the race of both, whose vehicle is the model on board
            (default: for each policy the race that it was trained in, which must have the same
            track and rules).
        parts: Some of the parts (default: all).
        conditions: Some rows of the part plants, such as 'all effects' 'charge 0.2'
            (default: all).
        drones: Drawn drones, which share --runs.
        laps: Laps of a run.
        runs: Number of runs.
        sampled: Fly with the noise of training.
        seed: Seed of batteries, gusts and sensors.
    """
    if not parts or "plants" in parts:
        opt.check_shares(runs, drones)
    with loading():
        from quadjax import compare as comparison
        from quadjax.config.loading import load_config
        from quadjax.evaluation.conditions import read_conditions
        from quadjax.plant.config import load_plant_config

    started = time.monotonic()
    chosen, folder = tuple(parts or comparison.PARTS), output / name
    if "plants" not in chosen:
        opt.refuse("without the part plants (--parts)", "conditions", "drones")
    plant, listed = load_plant_config(config, overrides), read_conditions("plants", conditions)
    contenders = comparison.contenders(
        {"E2E": e2e, "INDI": indi}, None if race is None else load_config(race)
    )
    protocol = {"laps": laps, "runs": runs, "seed": seed, "deterministic": not sampled}
    with results(folder, "comparison", comparison.FILES, overwrite) as new, steps() as report:
        options = (plant, protocol, listed, new, report, chosen, drones)
        text = comparison.compare(contenders, *options)
    print(text)
    wrote(f"{folder}/ in {time.monotonic() - started:.0f} s")
