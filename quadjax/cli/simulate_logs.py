"""Write flight logs of a simulated drone with known constants."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import Parser, count, names_of, parse, seed
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

RESIDUAL = "residual.npz"


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("simulate-logs", description=__doc__)
    parser.add_argument("--vehicle", default="bebop1.yaml", help=names_of("vehicles"))
    parser.add_argument("--residual", type=Path, help="a residual file (.npz) of the drone")
    parser.add_argument(
        "--random-residual", type=seed, metavar="SEED", help="write and use DIR/residual.npz"
    )
    parser.add_argument("--thrust-std", type=float, default=1.0, help="of that, m/s^2 (1.0)")
    parser.add_argument("--moment-std", type=float, default=0.015, help="of that, N m (0.015)")
    parser.add_argument("--flights", type=count, default=4, help="number of logs (4)")
    parser.add_argument("--seconds", type=float, default=30.0, help="of each flight (30)")
    parser.add_argument("--seed", type=seed, default=0, help="of the first flight (0)")
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="of the logs")
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace files of the same names in a folder that holds no such logs",
    )
    arguments = parse(parser, argv)
    if not 1.0 <= arguments.seconds <= 3600.0:
        raise InputError(f"--seconds is {arguments.seconds}, expected 1 to 3600")
    if arguments.residual and arguments.random_residual is not None:
        raise InputError("--residual and --random-residual exclude each other")
    return arguments


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate and write."""
    options = _arguments(arguments)
    with loading():
        import numpy as np

        from quadjax.core.folders import claim
        from quadjax.fitting.flight_log import write_log
        from quadjax.fitting.simulate import random_residual, simulate_flight
        from quadjax.fitting.vehicle_file import read_vehicle
        from quadjax.vehicle.protocol import VehicleParams
        from quadjax.vehicle.residual_file import read_residual, write_residual

    residual = read_residual(options.residual) if options.residual else None
    drawn, own = options.random_residual, None
    if drawn is not None:
        residual = own = random_residual(drawn, options.thrust_std, options.moment_std)
    vehicle = VehicleParams(read_vehicle(options.vehicle).motor, residual)
    files = ("flight_*.csv", *([RESIDUAL] if own else []))
    with claim(options.output, "logs", files, options.overwrite):
        for index in range(options.flights):
            columns = simulate_flight(vehicle, options.seed + index, options.seconds)
            if not all(np.isfinite(values).all() for values in columns.values()):
                raise InputError(
                    f"flight {index} with seed {options.seed + index} is not finite; is the "
                    "residual too strong for the motors?"
                )
            path = options.output / f"flight_{index}.csv"
            write_log(path, columns)
            print(f"wrote {path}")
        if own:
            write_residual(options.output / RESIDUAL, own, {"random": True, "seed": drawn})
