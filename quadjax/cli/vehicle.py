"""Print quantities derived from a vehicle file, or write one from data of an airframe.

Prints the hover command, the thrust-to-weight ratio, the largest body rates and the time constants
of each model in the file, and warns of implausible values. With key=value data (mass, wheelbase,
propeller, and motor_kv with battery_volts, or rpm_max) FILE is written first.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import Parser, check_writable, parse
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading

COMMENT = "docs/guide/vehicle.md has the formulas. Fit flight logs for better constants."


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    from quadjax.core.sections import describe
    from quadjax.vehicle.airframe import Airframe

    keys = "\n".join(f"  {key.key:<20}{key.description}" for key in describe(Airframe))
    parser = Parser(
        "vehicle",
        description=__doc__,
        epilog=f"Data (null: estimated as described):\n{keys}\n\nExample: quadjax vehicle "
        "my_drone.yaml mass=0.6 wheelbase=0.226 propeller=0.127 motor_kv=1900 battery_volts=14.8 "
        "thrust_to_weight=4",
    )
    parser.add_argument("file", metavar="FILE.yaml", help="vehicle file")
    parser.add_argument(
        "data",
        nargs="*",
        metavar="key=value",
        help="data of the airframe, from which FILE is written",
    )
    parser.add_argument(
        "--model", metavar="module:OBJECT", help="your own VehicleModel (default: those in FILE)"
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing FILE")
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> None:
    """Write a vehicle file if data is given, then print its summary."""
    options = _arguments(arguments)
    with loading():
        from quadjax.config.loading import vehicle_configs
        from quadjax.vehicle import registry
        from quadjax.vehicle.summary import describe, summarize, warnings

    if options.data:
        _write(Path(options.file), options.data, options.overwrite)
    for config in vehicle_configs(options.file, options.model):
        vehicle, model = config.vehicle, registry.model(config.vehicle.model)
        summary = summarize(model, vehicle.constants)
        print(f"{vehicle.name}, model {vehicle.model}")
        print(describe(model, summary))
        for text in warnings(model, summary, vehicle.constants):
            print(f"  warning: {text}")


def _write(path: Path, data: Sequence[str], overwrite: bool) -> None:
    from quadjax.core.files import write_text
    from quadjax.core.sections import build
    from quadjax.core.yaml_files import parse_overrides, to_yaml
    from quadjax.vehicle.airframe import Airframe

    airframe = build(Airframe, parse_overrides(data), "data")
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists already, allowed: another name, or --overwrite")
    check_writable(path, (".yaml",))
    motor = {name: float(f"{value:.6g}") for name, value in airframe.motor_constants().items()}
    head = {"name": path.stem, "mass": airframe.mass, "width": round(airframe.width, 4)}
    tree = {**head, "motor": motor}
    write_text(path, f"# From {' '.join(data)}\n# {COMMENT}\n{to_yaml(tree)}")
    print(f"wrote {path}")
