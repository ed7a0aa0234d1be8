"""``quadjax logs``."""

from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.core.errors import InputError
from quadjax.core.folders import results
from quadjax.core.interruptions import loading


def logs(
    plant: Annotated[opt.PlantConfig, Parameter(name="PLANT")],
    /,
    *overrides: opt.Overrides,
    output: opt.Folder,
    policy: tuple[opt.PolicyFile, ...],
    flights: opt.Runs = 4,
    seed: opt.Seed = 0,
    overwrite: opt.Flag = False,
    race: opt.Race = None,
    laps: opt.Laps = 6,
) -> None:
    """Write flight logs of policies on a simulated drone.

    Each flight is written to DIR/POLICY_RUN.csv. PLANT is cyberzoo (drone=3: its
    fourth drone), standin, or exact: a drone with the training model's constants, no
    other effects and no sensor errors.

    Example: quadjax logs standin --policy e2e --policy indi --output logs

    Args:
        output: Folder of the logs.
        policy: Policy that flies: a file, or a shipped one's name; may be repeated.
        flights: Number of logs, of each policy.
        seed: Seed of the first flight.
        overwrite: Replace logs of the same names.
        race: Race of the policies (default: the one that each was trained in).
    """
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.evaluation.plants import write_logs
        from quadjax.plant.config import load_plant_config
        from quadjax.plant.flights import plan_logs

    drone = load_plant_config(plant, overrides)
    config = None if race is None else load_config(race)
    names = [file.stem for file in policy]
    if len(set(names)) < len(names):
        listed = ", ".join(map(str, policy))
        raise InputError(f"two of the policies have the same name: {listed}")
    plans = {file.stem: plan_logs(config, drone, file, flights, laps) for file in policy}
    with (
        results(output, "logs", [f"{x}_*.csv" for x in names], overwrite) as new,
        steps() as report,
    ):
        written = [write_logs(plan, name, new, seed, report) for name, plan in plans.items()]
    for rows, ended in written:
        for (path, count), crash in zip(rows.items(), ended.crashes, strict=True):
            wrote(f"{output / path.name}, {count} rows {crash}".rstrip())
