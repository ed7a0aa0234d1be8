"""Recovery of a known model by a fit of its simulated logs.

Constants are compared with the true ones. The residual is compared with the true one on new
flights, without noise. The nominal fit absorbs part of a residual, so the sum of both is compared.
"""

import numpy as np

from quadjax.fitting.least_squares import r_squared
from quadjax.fitting.log_frames import rotation_of_euler
from quadjax.fitting.nominal import AXES, CONSTANTS, ModelInputs, nominal, residual_output
from quadjax.fitting.simulate import SensorNoise, simulate_flight
from quadjax.vehicle.motor import MotorConstants
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import Residual

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


def exact_motion(vehicle: VehicleParams, seed: int, seconds: float = 30.0) -> ModelInputs:
    """The motion of one simulated flight, every tenth sample of 500 Hz, without sensor noise."""
    columns = simulate_flight(vehicle, seed, seconds, noise=EXACT)

    def group(prefix: str, suffixes: str | tuple[str, ...]) -> np.ndarray:
        return np.stack([columns[prefix + suffix] for suffix in suffixes], axis=1)[::10]

    rotation = rotation_of_euler(group("att_", ("phi", "theta", "psi")))
    velocity = rotation.inv().apply(group("vel_", "xyz"))
    rpm = group("rpm_obs_", "1234")
    rpm_rate = (group("rpm_ref_", "1234") - rpm) / float(vehicle.constants.tau)
    return ModelInputs(rpm, rpm_rate, velocity, group("rate_", "pqr"))


def residual_recovered(
    truth: VehicleParams, found: MotorConstants, residual: Residual, motion: ModelInputs
) -> np.ndarray:
    """R^2 (4,) of az, Mx, My and Mz of the true residual, on a motion."""
    wanted, got = (residual_output(part, motion) for part in (truth.residual, residual))
    got = got + (nominal(found, motion) - nominal(truth.constants, motion))[:, 2:]
    return r_squared(wanted, got)
