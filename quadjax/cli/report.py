"""Tables and figures of flights, as text, LaTeX, PDF, SVG and PNG.

Each LABEL=FILE is a group of flights: the trajectories of an evaluation (quadjax evaluate --states
FILE.npz) or flight logs with positions (.csv, a glob pattern for several), real ones or those of
quadjax plant-logs. A group without a label has its file's name. CONFIG is the race that was flown:
its track has the gates, its vehicle the limits and time constants.
"""

import argparse
from collections.abc import Sequence

from quadjax.cli.arguments import Parser, add_code, add_output, add_overwrite, name, parse
from quadjax.core.interruptions import loading


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "report",
        description=__doc__,
        epilog="Example: quadjax report 'E2E simulated=e2e.npz' 'E2E flown=logs/e2e_*.csv' "
        "--name races",
    )
    parser.add_argument("flights", nargs="+", metavar="[LABEL=]FILE", help="flights of a group")
    parser.add_argument(
        "--race", default="e2e_shac", metavar="CONFIG", help="preset or YAML file (e2e_shac)"
    )
    parser.add_argument(
        "--logs", metavar="FIT.yaml", help="fit config whose section logs describes the columns"
    )
    add_code(parser)
    parser.add_argument("--name", type=name, default="report", help="of the folder (report)")
    add_output(parser)
    add_overwrite(parser, "report")
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a report."""
    options = _arguments(arguments)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.core.folders import results
        from quadjax.fitting.config import load_fit_config
        from quadjax.studies.report.flights import find_flights
        from quadjax.studies.report.run import FILES, write_report

    config = load_config(options.race)
    logs = None
    if options.logs is not None:
        logs = load_fit_config(options.logs, allow_code=options.allow_code).logs
    groups = find_flights(options.flights, config.track, logs)
    folder = options.output / options.name
    with results(folder, "report", FILES, options.overwrite) as new:
        text = write_report(groups, config, new)
    print(text)
    print(f"wrote {folder}/")
