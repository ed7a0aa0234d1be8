"""Recovery of a known model by a fit of its simulated logs.

Constants are compared with the true ones. The residual is compared with the true one on new
flights, without noise. The nominal fit absorbs part of a residual, so the sum of both is compared.
"""

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from quadjax.core.arguments import Parser, count, parse
from quadjax.core.errors import InputError
from quadjax.fitting.flight_log import rotation_of_euler
from quadjax.fitting.least_squares import r_squared
from quadjax.fitting.nominal import AXES, CONSTANTS, Motion, nominal, residual_output
from quadjax.fitting.simulate import SensorNoise, simulate_flight
from quadjax.fitting.vehicle_file import read_vehicle
from quadjax.vehicle.constants import MotorConstants
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import Residual
from quadjax.vehicle.residual_file import read_residual

NEW = 1000  # seed of the first new flight
EXACT = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0)


def constant_errors(
    truth: MotorConstants, found: MotorConstants, standard_errors: dict[str, float]
) -> dict[str, tuple[float, float]]:
    """Relative error of every fitted constant, and its error in standard errors."""
    names = [name for axis in AXES for name in CONSTANTS[axis]] + ["tau"]
    errors = {}
    for name in names:
        true = float(getattr(truth, name))
        wrong = float(getattr(found, name)) - true
        errors[name] = wrong / true, wrong / standard_errors[name]
    return errors


def exact_motion(vehicle: VehicleParams, seed: int, seconds: float = 30.0) -> Motion:
    """The motion of one simulated flight, every tenth sample of 500 Hz, without sensor noise."""
    columns = simulate_flight(vehicle, seed, seconds, noise=EXACT)

    def group(prefix: str, suffixes: str | tuple[str, ...]) -> np.ndarray:
        return np.stack([columns[prefix + suffix] for suffix in suffixes], axis=1)[::10]

    rotation = rotation_of_euler(group("att_", ("phi", "theta", "psi")))
    velocity = rotation.inv().apply(group("vel_", "xyz"))
    rpm = group("rpm_obs_", "1234")
    rpm_rate = (group("rpm_ref_", "1234") - rpm) / float(vehicle.constants.tau)
    return Motion(rpm, rpm_rate, velocity, group("rate_", "pqr"))


def residual_recovered(
    truth: VehicleParams, found: MotorConstants, residual: Residual, motion: Motion
) -> np.ndarray:
    """R^2 (4,) of az, Mx, My and Mz of the true residual, on a motion."""
    wanted, got = (residual_output(part, motion) for part in (truth.residual, residual))
    got = got + (nominal(found, motion) - nominal(truth.constants, motion))[:, 2:]
    return r_squared(wanted, got)


def _standard_errors(path: Path) -> dict[str, float]:
    try:
        reported = json.loads(path.read_text("utf-8"))["constants"]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: not the report of a fit ({error})") from None
    # Constants that the logs do not excite have none.
    return {name: c["standard_error"] or np.inf for name, c in reported.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Compare a fit of simulated logs with the model that generated them."""
    parser = Parser("recovery", description=main.__doc__)
    parser.add_argument("--fit", type=Path, required=True, help="folder of the fit, runs/NAME")
    parser.add_argument("--vehicle", default="bebop1.yaml", help="vehicle of the logs")
    parser.add_argument("--residual", type=Path, help="residual file of the logs")
    parser.add_argument("--flights", type=count, default=3, help="new flights to evaluate on (3)")
    options = parse(parser, arguments)
    truth = read_vehicle(options.vehicle).motor
    found = read_vehicle(str(options.fit / "vehicle.yaml")).motor
    errors = constant_errors(truth, found, _standard_errors(options.fit / "report.json"))
    print(f"{'constant':10}{'error':>8}{'in standard errors':>20}")
    for name, (relative, normal) in errors.items():
        print(f"{name:10}{100 * relative:+7.2f}%{normal:+20.1f}")
    if options.residual is None:
        return
    vehicle = VehicleParams(truth, read_residual(options.residual))
    residual = read_residual(options.fit / "residual.npz")
    print(f"\n{'new flight':10}" + "".join(f"{axis:>8}" for axis in AXES[2:]) + "  R^2 of residual")
    for seed in range(NEW, NEW + options.flights):
        fraction = residual_recovered(vehicle, found, residual, exact_motion(vehicle, seed))
        print(f"{seed:<10}" + "".join(f"{value:8.3f}" for value in fraction))
