"""``quadjax logs``."""

from typing import Annotated

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.folders import results
from quadjax.evaluation.plants import write_logs
from quadjax.fitting import simulate
from quadjax.plant.config import load_plant_config
from quadjax.plant.flights import plan_logs
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import read_residual, write_residual
from quadjax.vehicle.vehicle_file import read_vehicle

RACES = Group("Races on the plant", sort_key=1)
EXCITATION = Group("Excitation of a model", sort_key=2)
Seconds = Annotated[float, Parameter(converter=opt.number(1.0, 3600.0), group=EXCITATION)]
Vehicle = Annotated[
    str, opt.config_of("vehicles"), Parameter(metavar="FILE.yaml", group=EXCITATION)
]


def logs(
    plant: Annotated[opt.PlantConfig | None, Parameter(name="PLANT")] = None,
    /,
    *overrides: opt.Overrides,
    output: opt.Folder,
    flights: opt.Runs = 4,
    seed: opt.Seed = 0,
    overwrite: opt.Flag = False,
    policy: Annotated[list[opt.PolicyFile] | None, Parameter(group=RACES)] = None,
    race: Annotated[str, Parameter(group=RACES, metavar="CONFIG")] = "e2e",
    laps: Annotated[opt.Laps, Parameter(group=RACES)] = 6,
    vehicle: Vehicle = "bebop1.yaml",
    residual: Annotated[opt.InputFile | None, Parameter(group=EXCITATION)] = None,
    random_residual: Annotated[opt.Seed | None, Parameter(group=EXCITATION)] = None,
    thrust_std: Annotated[
        float, Parameter(group=EXCITATION, converter=opt.number(0.0, 100.0))
    ] = 1.0,
    moment_std: Annotated[
        float, Parameter(group=EXCITATION, converter=opt.number(0.0, 10.0))
    ] = 0.015,
    seconds: Seconds = 30.0,
) -> None:
    """Write flight logs of a simulated drone.

    With PLANT and --policy, policies race on the stand-in plant, and each flight is
    written to DIR/POLICY_RUN.csv. Without them, a drone of known constants is excited
    for a fit: DIR/flight_RUN.csv.

    Example: quadjax logs standin --policy e2e_nominal --policy indi --output logs

    Args:
        output: Folder of the logs.
        flights: Number of logs, of each policy.
        seed: Of the first flight.
        overwrite: Replace logs of the same names.
        policy: Policy that flies: a file, or a shipped one's name; may be repeated.
        race: Race of the policies.
        residual: A residual file (.npz) of the drone.
        random_residual: Seed of a random residual, which is written to DIR/residual.npz.
        thrust_std: Of the random residual, m/s^2.
        moment_std: Of the random residual, N m.
        seconds: Of each flight.
    """
    if plant is None:
        opt.refuse("without a PLANT, such as standin", "policy", "race", "laps")
    else:
        excitation = ("vehicle", "residual", "random_residual", "thrust_std", "moment_std")
        opt.refuse("with a PLANT", *excitation, "seconds")
        if not policy:
            raise InputError("--policy is missing: the policies that fly on the plant")
    opt.exclude("residual", "random_residual")
    if random_residual is None:
        opt.refuse("without --random-residual", "thrust_std", "moment_std")
    if plant is not None:
        drone, names = load_plant_config(plant, overrides), [str(file) for file in policy or ()]
        plans = plan_logs(load_config(race), drone, names, flights, laps)
        files = [f"{name}_*.csv" for name in plans]
        with results(output, "logs", files, overwrite) as new, steps() as report:
            logs = write_logs(plans, new, seed, report)
        for log in logs:
            wrote(f"{output / log.path.name}, {log.rows} rows {log.crash}".rstrip())
        return
    extra = read_residual(residual) if residual else None
    files = ["flight_*.csv"]
    if random_residual is not None:
        extra = simulate.random_residual(random_residual, thrust_std, moment_std)
        files.append("residual.npz")
    params = VehicleParams(read_vehicle(vehicle).motor, extra)
    with results(output, "logs", files, overwrite) as new, steps() as report:
        written = simulate.write_flights(params, new, flights, seconds, seed, report)
        if extra is not None and random_residual is not None:
            source = {"random": True, "seed": random_residual}
            write_residual(new / "residual.npz", extra, source)
            written = [*written, new / "residual.npz"]
    wrote(*(output / path.name for path in written))
