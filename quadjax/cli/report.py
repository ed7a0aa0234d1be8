"""``quadjax report``."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import wrote
from quadjax.core.errors import warn
from quadjax.core.folders import results
from quadjax.core.interruptions import loading


def report(
    *flights: Annotated[str, Parameter(name="[LABEL=]FILE", required=True)],
    race: opt.Race = None,
    logs: opt.Logs = opt.PLAIN_LOGS,
    output: opt.Folder = Path("runs/report"),
    overwrite: opt.Overwrite = False,
) -> None:
    """Write tables and figures of recorded flights.

    A file has the states of quadjax evaluate --states FILE.npz, or is a flight log
    (.csv, a glob pattern for several). Files of one label are one group. DIR gets
    tables and figures as text, LaTeX, PDF, SVG and PNG.

    Example: quadjax report "E2E=states.npz" "flown=logs/*.csv"

    Args:
        flights: One or more, with a label for the group.
        race: Race of logs (default: e2e); states contain the gates and constants of the race
            that was flown.
        output: Folder of the tables and figures.
    """
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.evaluation.report import FILES, Report
        from quadjax.evaluation.sources import load_groups

    config = load_config(race or "e2e")
    found = Report(
        load_groups(flights, config.track, logs.columns() if logs.logs else None), config
    )
    if race is not None and tuple(found.gates) != config.track.gates:
        warn(f"the flights are on another track than {config.track.name}, that of {race}")
    with results(output, "report", FILES, overwrite) as new:
        text = found.write(new)
    print(text)
    wrote(f"{output}/")
