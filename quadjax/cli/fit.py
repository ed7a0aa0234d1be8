"""``quadjax fit``."""

import time
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import steps, wrote
from quadjax.core.folders import results
from quadjax.core.interruptions import loading
from quadjax.core.resources import find_config


def fit(
    config: Annotated[str, Parameter(name="CONFIG"), opt.config_parameter("fit")],
    /,
    *overrides: opt.Overrides,
    name: opt.RunName | None = None,
    allow_code: opt.AllowCode = False,
    output: opt.RunsFolder = Path("runs"),
    overwrite: opt.Overwrite = False,
) -> None:
    """Fit the model of a drone to its flight logs.

    DIR/NAME gets vehicle.yaml (for vehicle.file=), residual.npz (for
    vehicle.residual=), report.txt, report.json, config.yaml and figures. The base
    vehicle's model is fitted: with a racing quadcopter (vehicle=5inch.yaml) its
    motors and the constants of each rotor, without a residual. Logs:
    CSV of Paparazzi, of a blackbox (Betaflight, INDIflight) and of the TII-RATM
    dataset, PX4's ULog, and your own columns or reader (logs.format).

    Example: quadjax fit paparazzi 'logs.files=[logs/*.csv]' --name my_drone
    """
    with loading():
        from quadjax.fitting import fit as fits
        from quadjax.fitting.config import load_fit_config
        from quadjax.fitting.flight_log import find_logs
        from quadjax.fitting.report import PATTERNS, tables, write_figures, write_results

    started = time.monotonic()
    path = find_config(config, "fit")
    settings = load_fit_config(path, [*overrides, *([f"name={name}"] if name else [])], allow_code)
    folder = output / settings.name
    find_logs(settings.logs, path.parent)  # before the folder is created
    with results(folder, "fit", PATTERNS, overwrite) as new, steps() as report:
        result = fits.fit(settings, path.parent, report)
        report("writing")
        written = write_results(result, new)
        written += write_figures(result, new) if settings.figures else []
    print(tables(result))
    wrote(f"{len(written)} files to {folder}/ in {time.monotonic() - started:.1f} s")
