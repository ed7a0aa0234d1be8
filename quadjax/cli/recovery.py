"""Compare a fit of simulated logs with the model that generated them."""

from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import Parser, count, parse
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare and print."""
    parser = Parser("recovery", description=__doc__)
    parser.add_argument("--fit", type=Path, required=True, help="folder of the fit, runs/NAME")
    parser.add_argument("--vehicle", default="bebop1.yaml", help="vehicle of the logs")
    parser.add_argument("--residual", type=Path, help="residual file of the logs")
    parser.add_argument("--flights", type=count, default=3, help="new flights to evaluate on (3)")
    options = parse(parser, arguments)
    with loading():
        from quadjax.fitting.nominal import AXES
        from quadjax.fitting.vehicle_file import read_vehicle
        from quadjax.studies import recovery
        from quadjax.vehicle.protocol import VehicleParams
        from quadjax.vehicle.residual_file import read_residual

    truth = read_vehicle(options.vehicle).motor
    found = read_vehicle(str(options.fit / "vehicle.yaml")).motor
    deviations = _standard_errors(options.fit / "report.json")
    print(f"{'constant':10}{'error':>8}{'in standard errors':>20}")
    for name, (relative, normal) in recovery.constant_errors(truth, found, deviations).items():
        print(f"{name:10}{100 * relative:+7.2f}%{normal:+20.1f}")
    if options.residual is None:
        return
    vehicle = VehicleParams(truth, read_residual(options.residual))
    residual = read_residual(options.fit / "residual.npz")
    print(f"\n{'new flight':10}" + "".join(f"{axis:>8}" for axis in AXES[2:]) + "  R^2 of residual")
    for seed in range(recovery.NEW, recovery.NEW + options.flights):
        motion = recovery.exact_motion(vehicle, seed)
        fraction = recovery.residual_recovered(vehicle, found, residual, motion)
        print(f"{seed:<10}" + "".join(f"{value:8.3f}" for value in fraction))


def _standard_errors(path: Path) -> dict[str, float]:
    """Standard error of each constant; infinity for constants that the logs do not excite."""
    from quadjax.core.files import read_json

    try:
        constants = read_json(path)["constants"]
        return {name: c["standard_error"] or float("inf") for name, c in constants.items()}
    except (LookupError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not the report of a fit ({error})") from None
