"""Compute best known laps and lower bounds of the published tracks for several drones.

Each pair of a track and a drone is written to FOLDER as .json and .npz when it is done. The script
continues where it was interrupted: a pair with a .json file is not computed again. The table, of
docs/design/limits.md, is printed as Markdown.

    python -m benchmarks.limits runs/limits
"""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import script
from quadjax.cli.options import Flag, Folder, whole
from quadjax.cli.output import steps
from quadjax.core.errors import InputError
from quadjax.core.interruptions import interruptions
from quadjax.studies import limits_table

STOPPING = b"\nstopping: the table is continued by the same command\n"
Names = Annotated[list[str] | None, Parameter(consume_multiple=True, metavar="NAME ...")]


def limits(
    folder: Annotated[Path, Parameter(name="FOLDER")],
    /,
    *,
    tracks: Names = None,
    drones: Names = None,
    seconds: Annotated[int, Parameter(converter=whole(1, 86_400))] = 300,
    starts: Annotated[int, Parameter(converter=whole(1, 100))] = 2,
    policies: Folder | None = None,
    no_centers: Flag = False,
) -> int:
    """Compute best known laps and lower bounds of several drones, and print the table.

    Args:
        folder: Of the results.
        tracks: Names of tracks (default: the table's five).
        drones: Names of drones (default: all five).
        seconds: Processor time of a pair's searches at most.
        starts: Number of initial guesses.
        policies: Folder of policies to compare with and to start from, named as the results:
            square4_5-inch.npz (default: the shipped ones).
        no_centers: No lap through the centers of the gates.
    """
    chosen = tracks or list(limits_table.TRACKS)
    if policies is not None and not policies.is_dir():
        raise InputError(f"--policies: {policies} is not a folder")
    names = drones or list(limits_table.DRONES)
    for name in names:
        if name not in limits_table.DRONES:
            known = ", ".join(limits_table.DRONES)
            raise InputError(f"--drones: {name!r} is not a drone of the table: {known}")
    with interruptions(STOPPING) as stop, steps() as report:
        limits_table.make(
            folder, chosen, names, seconds, policies, stop, report, starts, not no_centers
        )
    print(limits_table.markdown(folder, chosen))
    return 1 if stop.is_set() else 0


if __name__ == "__main__":
    script(limits)
