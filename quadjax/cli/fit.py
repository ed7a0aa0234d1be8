"""Fit the model of a drone to its flight logs.

DIR/NAME gets vehicle.yaml (for vehicle.file=), residual.npz (for vehicle.residual=), report.txt,
report.json, config.yaml and figures. The base vehicle's model is fitted: with a racing quadcopter
(vehicle=5inch.yaml) its motors and the constants of each rotor, without a residual or figures.
Logs: CSV of Paparazzi, of a blackbox (Betaflight, INDIflight) and of the TII-RATM dataset, PX4's
ULog, and your own columns or reader (logs.format).
"""

import argparse
import time
from collections.abc import Sequence

from quadjax.cli.arguments import (
    Parser,
    add_code,
    add_config,
    add_name,
    add_output,
    names_of,
    overrides_of,
    parse,
)
from quadjax.cli.progress import steps
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import find_config


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("fit", description=__doc__)
    add_config(parser, names_of("fit"))
    add_name(parser)
    add_code(parser)
    add_output(parser)
    parser.add_argument(
        "--overwrite", action="store_true", help="replace an earlier fit of the same name"
    )
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the config, fit, print, write."""
    started = time.monotonic()
    options = _arguments(arguments)
    with loading():
        from rich.console import Console

        from quadjax.core.folders import claim, present_files, replacement
        from quadjax.fitting.config import load_fit_config
        from quadjax.fitting.figures import write_figures
        from quadjax.fitting.flight_log import find_logs
        from quadjax.fitting.pipeline import run_fit
        from quadjax.fitting.racing_fit import read_racing_vehicle, run_racing_fit
        from quadjax.fitting.racing_report import racing_tables, write_racing_results
        from quadjax.fitting.report import PATTERNS, tables, write_results

    path = find_config(options.config, "fit")
    config = load_fit_config(path, overrides_of(options), options.allow_code)
    folder = options.output / config.name
    find_logs(config.logs, path.parent)  # before the folder is created
    with (
        claim(folder, "fit", PATTERNS, options.overwrite),
        steps(Console(stderr=True)) as report,
    ):
        if present_files(folder, PATTERNS) and not options.overwrite:
            raise InputError(
                f"{folder} holds a fit already: replace it (--overwrite) or choose another name"
            )
        racing = read_racing_vehicle(config.vehicle, path.parent)
        if racing is not None:
            quadcopter = run_racing_fit(config, path.parent, racing, report)
        else:
            result = run_fit(config, path.parent, report)
        report("writing")
        with replacement(folder, PATTERNS) as new:
            if racing is not None:
                written, text = write_racing_results(quadcopter, new), racing_tables(quadcopter)
            else:
                written, text = write_results(result, new), tables(result)
                written += write_figures(result, new) if config.figures else []
    print(text)
    print(f"wrote {len(written)} files to {folder}/ in {time.monotonic() - started:.1f} s")
