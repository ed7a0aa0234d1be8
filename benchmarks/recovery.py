"""Compare a fit of simulated logs with the model that generated them.

quadjax logs --random-residual 1 --output runs/logs
quadjax fit paparazzi 'logs.files=[runs/logs/*.csv]' --name recovered
python -m benchmarks.recovery --fit runs/recovered --residual runs/logs/residual.npz
"""

from pathlib import Path

from quadjax.cli import script
from quadjax.cli.options import Count, Folder, InputFile
from quadjax.core.errors import InputError
from quadjax.core.files import read_json
from quadjax.fitting.nominal import AXES
from quadjax.studies import recovery as study
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import read_residual
from quadjax.vehicle.vehicle_file import read_vehicle


def recovery(
    *,
    fit: Folder,
    vehicle: str = "bebop1.yaml",
    residual: InputFile | None = None,
    flights: Count = 3,
) -> None:
    """Compare a fit of simulated logs with the model that generated them.

    Args:
        fit: Folder of the fit.
        vehicle: Vehicle of the logs.
        residual: Residual file of the logs.
        flights: New flights to evaluate on.
    """
    truth = read_vehicle(vehicle).motor
    fitted = read_vehicle(str(fit / "vehicle.yaml")).motor
    deviations = _standard_errors(fit / "report.json")
    print(f"{'constant':10}{'error':>8}{'in standard errors':>20}")
    for name, (relative, normal) in study.constant_errors(truth, fitted, deviations).items():
        print(f"{name:10}{100 * relative:+7.2f}%{normal:+20.1f}")
    if residual is None:
        return
    params = VehicleParams(truth, read_residual(residual))
    networks = read_residual(fit / "residual.npz")
    print(f"\n{'new flight':10}" + "".join(f"{axis:>8}" for axis in AXES[2:]) + "  R^2 of residual")
    for seed in range(study.NEW, study.NEW + flights):
        motion = study.exact_motion(params, seed)
        fraction = study.residual_recovered(params, fitted, networks, motion)
        print(f"{seed:<10}" + "".join(f"{value:8.3f}" for value in fraction))


def _standard_errors(path: Path) -> dict[str, float]:
    """Standard error of each constant; infinity for constants that the logs do not excite."""
    try:
        constants = read_json(path)["constants"]
        return {name: c["standard_error"] or float("inf") for name, c in constants.items()}
    except (LookupError, TypeError, AttributeError) as error:
        raise InputError(f"{path}: not the report of a fit ({error})") from None


if __name__ == "__main__":
    script(recovery)
