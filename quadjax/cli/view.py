"""Write flights as an interactive 3D page: one HTML file that opens without a server or network.

A flight is a training run's folder; a policy file, or the name of one that comes with quadjax (e2e,
e2e_fastest, indi, ..); states of quadjax evaluate --states FILE.npz; the best known lap of quadjax
limit --npz FILE.npz; a flight log (.csv); or flights that an earlier quadjax view --output
FILE.json wrote. Lap times (.json, of quadjax evaluate --json or limit --json) are marked on the
time line. All flights start together. Policies fly their own race, or that of --race, with the mean
action.
"""

import argparse
import dataclasses
import webbrowser
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from quadjax.cli.arguments import Parser, add_code, check_outputs, laps, parse, runs, seed
from quadjax.cli.progress import steps
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.fitting.config import LogsConfig


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("view", description=__doc__, epilog="Example: quadjax view e2e indi")
    parser.add_argument("flights", nargs="+", metavar="FLIGHTS", help="one or more, as above")
    parser.add_argument(
        "--output",
        default="flights.html",
        metavar="FILE.html",
        help="page, or with the suffix .json its data alone (default: flights.html)",
    )
    parser.add_argument(
        "--name", action="append", default=[], dest="names", help="of the next flight, in order"
    )
    parser.add_argument("--title", help="of the page (default: the track's name)")
    parser.add_argument(
        "--race",
        metavar="CONFIG",
        help="race of the policies, and gates of files that contain none",
    )
    parser.add_argument("--laps", type=laps, help="of policies (default: evaluate.laps)")
    parser.add_argument("--runs", type=runs, default=1, help="of each policy (default: 1)")
    parser.add_argument("--sampled", action="store_true", help="sampled actions of policies")
    parser.add_argument("--seed", type=seed, default=0, help="of the noise (default: 0)")
    parser.add_argument(
        "--logs", metavar="FIT.yaml", help="columns and frames of flight logs: a fit config"
    )
    add_code(parser)
    parser.add_argument("--open", action="store_true", help="open the page in the browser")
    arguments = parse(parser, argv)
    if len(arguments.names) > len(arguments.flights):
        raise InputError(f"--name {arguments.names[-1]}: more names than flights")
    if arguments.open and not arguments.output.endswith(".html"):
        raise InputError(f"--open needs an .html file, --output is {arguments.output}")
    check_outputs(arguments, output=(".html", ".json"))
    return arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """Write a page."""
    options, console = _arguments(arguments), Console(stderr=True)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.files import write_json
        from quadjax.dashboard.sources import Options, scene_record
        from quadjax.view.page import write_page

    race = load_config(options.race) if options.race else None
    reading = Options(
        race,
        options.laps,
        options.runs,
        options.sampled,
        options.seed,
        _logs(options),
        report=lambda line: console.print(line, highlight=False, soft_wrap=True),
    )
    title = options.title or (race.track.name if race else "") or "Flights"
    with steps(console) as report:
        reading = dataclasses.replace(reading, progress=report)
        record = scene_record(options.flights, options.names, title, reading)
    if options.output.endswith(".json"):
        write_json(options.output, record)
    else:
        write_page(options.output, record)
    count, size = len(record["flights"]), Path(options.output).stat().st_size
    flights = f"{count} flight{'' if count == 1 else 's'}"
    console.print(f"wrote {options.output}: {flights}, {size / 2**20:.1f} MiB", highlight=False)
    if options.open:
        webbrowser.open(Path(options.output).resolve().as_uri())
    return 0


def _logs(options: argparse.Namespace) -> "LogsConfig":
    """The columns and frames of flight logs that a fit config names."""
    from quadjax.fitting.config import LogsConfig, load_fit_config

    if options.logs is None:
        return LogsConfig()
    return load_fit_config(options.logs, allow_code=options.allow_code).logs
