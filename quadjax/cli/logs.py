"""``quadjax logs``."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Group, Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.vehicle.residual import Residual

RESIDUAL = "residual.npz"
RACES = Group("Races on the plant", sort_key=1)
EXCITATION = Group("Excitation of a model", sort_key=2)
Seconds = Annotated[float, Parameter(converter=opt.number(1.0, 3600.0), group=EXCITATION)]
Vehicle = Annotated[
    str | None, opt.config_of("vehicles"), Parameter(metavar="FILE.yaml", group=EXCITATION)
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
    race: Annotated[opt.Race, Parameter(group=RACES)] = None,
    laps: Annotated[opt.Laps | None, Parameter(group=RACES)] = None,
    vehicle: Vehicle = None,
    residual: Annotated[opt.InputFile | None, Parameter(group=EXCITATION)] = None,
    random_residual: Annotated[opt.Seed | None, Parameter(group=EXCITATION)] = None,
    thrust_std: Annotated[float, Parameter(group=EXCITATION)] = 1.0,
    moment_std: Annotated[float, Parameter(group=EXCITATION)] = 0.015,
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
        overwrite: Replace files of the same names in a folder that holds no such logs.
        policy: Policy that flies: a file, or a shipped one's name; may be repeated.
        race: Race of the policies (default: e2e).
        laps: Laps of each flight (default: 6).
        residual: A residual file (.npz) of the drone.
        random_residual: Seed of a random residual, which is written to DIR/residual.npz.
        thrust_std: Of the random residual, m/s^2.
        moment_std: Of the random residual, N m.
        seconds: Of each flight.
    """
    if plant is None:
        if policy or race or laps:
            raise InputError("--policy, --race and --laps need a PLANT, such as standin")
        if residual and random_residual is not None:
            raise InputError("--residual and --random-residual exclude each other")
        random = None if random_residual is None else (random_residual, thrust_std, moment_std)
        _excite(
            vehicle or "bebop1.yaml", residual, random, flights, seconds, seed, output, overwrite
        )
        return
    if not policy:
        raise InputError("--policy is missing: the policies that fly on the plant")
    if vehicle or residual or random_residual is not None:
        raise InputError("--vehicle, --residual and --random-residual have no effect with a PLANT")
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.folders import claim
        from quadjax.plant.config import load_plant_config
        from quadjax.plant.logs import write_logs
        from quadjax.studies.plant_races import plan_logs

    drone = load_plant_config(plant, overrides)
    files = [str(file) for file in policy]
    plans = plan_logs(load_config(race or "e2e"), drone, files, flights, laps or 6)
    patterns = [f"{name}_*.csv" for name in plans]
    with claim(output, "logs", patterns, overwrite), steps() as report:
        written = write_logs(plans, output, seed, report)
    for log in written:
        print(f"wrote {log.path}, {log.rows} rows {log.crash}".rstrip())


def _excite(
    vehicle: str,
    residual: Path | None,
    random: tuple[int, float, float] | None,
    flights: int,
    seconds: float,
    seed: int,
    output: Path,
    overwrite: bool,
) -> None:
    """Logs of a drone with known constants, and with a residual, read or random."""
    with loading():
        import numpy as np

        from quadjax.core.folders import claim
        from quadjax.fitting.flight_log import write_log
        from quadjax.fitting.simulate import random_residual, simulate_flight
        from quadjax.fitting.vehicle_file import read_vehicle
        from quadjax.vehicle.protocol import VehicleParams
        from quadjax.vehicle.residual import read_residual, write_residual

    extra: Residual | None = read_residual(residual) if residual else None
    if random is not None:
        extra = random_residual(*random)
    params = VehicleParams(read_vehicle(vehicle).motor, extra)
    files = ("flight_*.csv", *([RESIDUAL] if random else []))
    with claim(output, "logs", files, overwrite), steps() as report:
        for index in range(flights):
            report(f"flight {index + 1} of {flights}")
            columns = simulate_flight(params, seed + index, seconds)
            if not all(np.isfinite(values).all() for values in columns.values()):
                raise InputError(
                    f"flight {index} with seed {seed + index} is not finite; is the "
                    "residual too strong for the motors?"
                )
            write_log(output / f"flight_{index}.csv", columns)
            print(f"wrote {output / f'flight_{index}.csv'}")
        if random is not None and extra is not None:
            write_residual(output / RESIDUAL, extra, {"random": True, "seed": random[0]})
