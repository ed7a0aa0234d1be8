"""Compute best known laps and lower bounds of the published tracks for several drones.

Each pair of a track and a drone is written to FOLDER as .json and .npz when it is done. The command
continues where it was interrupted: a pair with a .json file is not computed again. The table is
printed as Markdown.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console

from quadjax.cli.arguments import Parser, parse, whole
from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions, loading

STOPPING = b"\nstopping: the table is continued by the same command\n"
DEFAULT_SECONDS, MOST_SECONDS = 300, 86_400


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("limit-table", description=__doc__)
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="of the results")
    parser.add_argument(
        "--tracks", nargs="+", metavar="TRACK", help="names of tracks (default: the table's five)"
    )
    parser.add_argument("--drones", nargs="+", metavar="DRONE", help="names (default: all five)")
    parser.add_argument(
        "--seconds",
        type=whole(1, MOST_SECONDS),
        default=DEFAULT_SECONDS,
        help=f"processor time of a pair's searches at most (default: {DEFAULT_SECONDS})",
    )
    parser.add_argument(
        "--starts", type=whole(1, 100), default=2, help="number of initial guesses (default: 2)"
    )
    parser.add_argument(
        "--policies",
        type=Path,
        metavar="FOLDER",
        help="policies to compare with and to start from, named as the results: "
        "square4_5-inch.npz (default: the shipped ones)",
    )
    parser.add_argument(
        "--no-centers", action="store_true", help="no lap through the centers of the gates"
    )
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute what is missing and print the table."""
    options, console = _arguments(arguments), Console(stderr=True)
    with loading():
        from quadjax.studies import limits_table

    tracks = options.tracks or list(limits_table.TRACKS)
    if options.policies is not None and not options.policies.is_dir():
        raise InputError(f"--policies: {options.policies} is not a folder")
    drones = options.drones or list(limits_table.DRONES)
    for name in drones:
        if name not in limits_table.DRONES:
            known = ", ".join(limits_table.DRONES)
            raise InputError(f"--drones: {name!r} is not a drone of the table: {known}")
    with interruptions(STOPPING) as stop, console.status("compiling") as status:
        limits_table.make(
            options.folder,
            tracks,
            drones,
            options.seconds,
            options.policies,
            stop,
            status.update,
            options.starts,
            not options.no_centers,
        )
    print(limits_table.markdown(options.folder, tracks))
    return 1 if stop.is_set() else 0
