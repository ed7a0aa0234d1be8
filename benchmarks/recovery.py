"""Compare a fit of simulated logs with the model that generated them.

The residual is compared on new flights, without noise. The nominal fit absorbs some of a residual,
so the sum of both is compared.

quadjax logs --random-residual 1 --output runs/logs
quadjax fit paparazzi 'logs.files=[runs/logs/*.csv]' --name recovered
python -m benchmarks.recovery --fit runs/recovered --residual runs/logs/residual.npz
"""

import argparse
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from quadjax.core.files import read_json
from quadjax.fitting.nominal import AXES, CONSTANTS, ModelInputs, nominal, residual_output
from quadjax.fitting.regression import r_squared
from quadjax.fitting.simulate import SensorNoise, simulate_flight
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import read_residual
from quadjax.vehicle.vehicle_file import read_vehicle

NEW = 1000  # seed of the first new flight
EXACT = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0)


def constant_errors(truth, fitted, deviations) -> dict[str, tuple[float, float]]:
    """Relative error of every fitted constant, and its error in standard errors."""
    errors = {}
    for name in [*(name for axis in AXES for name in CONSTANTS[axis]), "tau"]:
        true = float(getattr(truth, name))
        error = float(getattr(fitted, name)) - true
        errors[name] = error / true, error / deviations[name]
    return errors


def exact_motion(vehicle, seed, seconds=30.0, sample_rate=500.0) -> ModelInputs:
    """The motion of one simulated flight, every tenth sample, without sensor noise."""
    columns = simulate_flight(vehicle, seed, seconds, noise=EXACT, sample_rate=sample_rate)

    def group(prefix, suffixes) -> np.ndarray:
        return np.stack([columns[prefix + suffix] for suffix in suffixes], axis=1)[::10]

    rotation = Rotation.from_euler("ZYX", group("att_", ("psi", "theta", "phi")))
    rpm = group("rpm_obs_", "1234")
    rpm_rate = (group("rpm_ref_", "1234") - rpm) / float(vehicle.constants.tau)
    velocity = rotation.inv().apply(group("vel_", "xyz"))
    return ModelInputs(rpm, rpm_rate, velocity, group("rate_", "pqr"))


def residual_recovered(truth, fitted, residual, motion) -> np.ndarray:
    """R^2 (4,) of az, Mx, My and Mz of the true residual, on a motion."""
    true, found = (residual_output(each, motion) for each in (truth.residual, residual))
    absorbed = nominal(fitted, motion) - nominal(truth.constants, motion)
    return r_squared(true, found + absorbed[:, 2:])


def main() -> None:
    """Print the errors of the constants, and R^2 of the residual on new flights."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--fit", type=Path, required=True, help="folder of the fit")
    parser.add_argument("--vehicle", default="bebop1.yaml", help="of the logs")
    parser.add_argument("--residual", type=Path, help="of the logs")
    parser.add_argument("--flights", type=int, default=3, help="new ones")
    options = parser.parse_args()
    truth = read_vehicle(options.vehicle).motor
    fitted = read_vehicle(str(options.fit / "vehicle.yaml")).motor
    constants = read_json(options.fit / "report.json")["constants"]
    deviations = {name: c["standard_error"] or float("inf") for name, c in constants.items()}
    print(f"{'constant':10}{'error':>8}{'in standard errors':>20}")
    for name, (relative, normal) in constant_errors(truth, fitted, deviations).items():
        print(f"{name:10}{100 * relative:+7.2f}%{normal:+20.1f}")
    if options.residual is None:
        return
    params = VehicleParams(truth, read_residual(options.residual))
    networks = read_residual(options.fit / "residual.npz")
    print(f"\n{'new flight':10}" + "".join(f"{axis:>8}" for axis in AXES[2:]) + "  R^2 of residual")
    for seed in range(NEW, NEW + options.flights):
        fraction = residual_recovered(params, fitted, networks, exact_motion(params, seed))
        print(f"{seed:<10}" + "".join(f"{value:8.3f}" for value in fraction))


if __name__ == "__main__":
    main()
