"""Write flight logs of the stand-in plant: of each policy's flights, DIR/POLICY_RUN.csv."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import Parser, add_config, laps, names_of, parse, runs, seed
from quadjax.cli.progress import steps
from quadjax.core.interruptions import loading


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("plant-logs", description=__doc__)
    add_config(parser, names_of("plant"))
    parser.add_argument(
        "--policy",
        action="append",
        required=True,
        metavar="FILE.npz",
        help="policy that flies: a file, or a shipped one's name; repeat it for several",
    )
    parser.add_argument("--race", default="e2e_shac", metavar="CONFIG", help="preset or YAML file")
    parser.add_argument("--flights", type=runs, default=4, help="of each policy (4)")
    parser.add_argument("--laps", type=laps, default=6, help="of each flight (6)")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--output", type=Path, required=True, metavar="DIR", help="of the logs")
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace files of the same names in a folder that holds no such logs",
    )
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> None:
    """Simulate policies on the plant and write their logs."""
    options = _arguments(arguments)
    with loading():
        from rich.console import Console

        from quadjax.config.loading import load_config
        from quadjax.core.folders import claim
        from quadjax.plant.config import load_plant_config
        from quadjax.plant.logs import write_logs
        from quadjax.studies.plant_races import plan_logs

    plant = load_plant_config(options.config, options.overrides)
    race = load_config(options.race)
    plans = plan_logs(race, plant, options.policy, options.flights, options.laps)
    files = [f"{name}_*.csv" for name in plans]
    with (
        claim(options.output, "logs", files, options.overwrite),
        steps(Console(stderr=True)) as report,
    ):
        written = write_logs(plans, options.output, options.seed, report)
    for log in written:
        print(f"wrote {log.path}, {log.rows} rows {log.crash}".rstrip())
