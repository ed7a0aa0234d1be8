"""How much of a simulated drone's known model a fit of its logs has found.

The constants are held against the true ones. The residual is held against the true one on new
flights, which no fit has seen and whose motion is known without noise. The nominal fit takes its
share of a residual, so what must come back is the sum of both, less the true nominal model. As a
command, after ``quadjax.fitting.synthetic_log`` and ``quadjax fit``::

    python -m quadjax.studies.recovery --fit runs/try --residual runs/truth.npz
"""

import json
from pathlib import Path

import numpy as np

from quadjax.cli.arguments import Parser, count, parse
from quadjax.core.errors import InputError, command_line
from quadjax.fitting.estimator_reference import residual_output
from quadjax.fitting.flight_log import rotation_of_euler
from quadjax.fitting.least_squares import r_squared
from quadjax.fitting.nominal import AXES, CONSTANTS, Motion, nominal
from quadjax.fitting.synthetic_log import SensorNoise, simulate_flight
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
    """Of every fitted constant: its relative error, and its error in standard errors."""
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
    velocity = np.einsum("nij,ni->nj", rotation, group("vel_", "xyz"))
    rpm = group("rpm_obs_", "1234")
    rpm_rate = (group("rpm_ref_", "1234") - rpm) / float(vehicle.constants.tau)
    return Motion(rpm, rpm_rate, velocity, group("rate_", "pqr"))


def residual_recovered(
    truth: VehicleParams, found: MotorConstants, residual: Residual, motion: Motion
) -> np.ndarray:
    """R^2 (4,) of az, Mx, My and Mz of the true residual, on a motion."""
    wanted, got = _extra(truth.residual, motion), _extra(residual, motion)
    got += (nominal(found, motion) - nominal(truth.constants, motion))[:, 2:]
    return r_squared(wanted, got)


def _extra(residual: Residual, motion: Motion) -> np.ndarray:
    force, moment = residual_output(residual, motion)
    return np.concatenate([force[:, None], moment], axis=1)


def _standard_errors(path: Path) -> dict[str, float]:
    try:
        told = json.loads(path.read_text("utf-8"))["constants"]
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{path}: not the report of a fit ({error})") from None
    # A constant that the logs say nothing of has none.
    return {name: c["standard_error"] or np.inf for name, c in told.items()}


def main() -> None:
    """Compare a fit of simulated logs with the model that made them."""
    parser = Parser(description=main.__doc__)
    parser.add_argument("--fit", type=Path, required=True, help="folder of the fit, runs/NAME")
    parser.add_argument("--vehicle", default="bebop1.yaml", help="what the logs were made with")
    parser.add_argument("--residual", type=Path, help="residual file they were made with")
    parser.add_argument("--flights", type=count, default=3, help="new flights to judge it on")
    words = parse(parser)
    truth = read_vehicle(words.vehicle, Path()).motor
    found = read_vehicle(str(words.fit / "vehicle.yaml"), Path()).motor
    errors = constant_errors(truth, found, _standard_errors(words.fit / "report.json"))
    print(f"{'constant':10}{'error':>8}{'in standard errors':>20}")
    for name, (relative, normal) in errors.items():
        print(f"{name:10}{100 * relative:+7.2f}%{normal:+20.1f}")
    if words.residual is None:
        return
    vehicle = VehicleParams(truth, read_residual(words.residual))
    residual = read_residual(words.fit / "residual.npz")
    print(f"\n{'new flight':10}" + "".join(f"{axis:>8}" for axis in AXES[2:]) + "  R^2 of residual")
    for seed in range(NEW, NEW + words.flights):
        share = residual_recovered(vehicle, found, residual, exact_motion(vehicle, seed))
        print(f"{seed:<10}" + "".join(f"{value:8.3f}" for value in share))


if __name__ == "__main__":
    command_line(main)()
