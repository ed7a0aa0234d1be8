"""Fit the model of a drone to its flight logs.

usage: python scripts/fit.py configs/fit/NAME.yaml [key=value ...]

Writes to runs/NAME/: vehicle.yaml (for vehicle.file=), residual.npz (for vehicle.residual=),
report.txt, report.json, config.yaml and figures.
"""

import argparse
import time
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from quadjax.cli.arguments import Parser, check_writable, parse
from quadjax.core.errors import command_line
from quadjax.fitting.figures import write_figures
from quadjax.fitting.pipeline import load_fit_config, run_fit
from quadjax.fitting.report import tables, write_results


@command_line
def main() -> None:
    """Read the config, fit, print, write."""
    parser = Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("config", type=Path, help="a YAML file of configs/fit")
    parser.add_argument("words", nargs="*", metavar="key=value", help="override a key, dotted")
    arguments = parse(parser)
    started = time.monotonic()
    config = load_fit_config(arguments.config, arguments.words)
    folder = Path(config.runs) / config.name
    check_writable(folder / "vehicle.yaml")
    columns = (TextColumn("{task.description:50}"), BarColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    quiet = not console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=quiet) as progress:
        task = progress.add_task("starting", total=8 if config.residual.fit else 4)

        def report(line: str) -> None:
            progress.update(task, description=line, advance=1)

        result = run_fit(config, arguments.config.parent, report)
        report("writing")
        written = write_results(result, folder)
        if config.figures:
            written += write_figures(result, folder)
    print(tables(result))
    print(f"wrote {len(written)} files to {folder}/ in {time.monotonic() - started:.1f} s")


if __name__ == "__main__":
    main()
