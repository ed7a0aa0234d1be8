"""The disturbance estimator over a whole log in float64 NumPy and SciPy.

Written independently of ``quadjax.vehicle.estimator``, as the reference of that and of the exported
C.
"""

import numpy as np
from scipy.signal import butter, lfilter

from quadjax.fitting.nominal import ModelInputs, angular_moment, nominal, residual_output
from quadjax.vehicle.protocol import VehicleParams


def estimate(
    vehicle: VehicleParams,
    signals: dict[str, np.ndarray],
    sample_rate: float,
    cutoff: float = 8.0,
    explicit_euler: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """External moment and specific force over a log that starts without disturbance.

    Args:
        vehicle: constants, and residual if any.
        signals: ``gyro`` (n, 3) rad/s, ``specific_force`` (n, 3) m/s^2, ``rpm`` (n, 4) and
            ``body_velocity`` (n, 3) m/s, sampled evenly.
        sample_rate: Hz.
        cutoff: of the low-pass, Hz.
        explicit_euler: the samples are the steps of an explicit Euler simulation.

    Returns:
        Moments (n, 3), N m, and specific forces (n, 3), m/s^2, body frame.
    """
    signals = {name: np.asarray(value, np.float64) for name, value in signals.items()}
    b, a = butter(2, cutoff, fs=sample_rate)
    half_a_sample = (0.0, 2.0 * b[0], 2.0 * b[0]) if explicit_euler else b

    def derivative(signal: np.ndarray) -> np.ndarray:
        # s -> 2 f (1 - z^-1) / (1 + z^-1); the denominator cancels one of H's two zeros at -1.
        change = 2.0 * sample_rate * b[0] * np.array([1.0, 0.0, -1.0])
        return lfilter(change, a, signal - signal[0], axis=0)

    gyro, rpm = signals["gyro"], signals["actuators"]
    still = np.zeros_like(gyro)
    motion = ModelInputs(rpm, np.zeros_like(rpm), signals["body_velocity"], gyro)
    force, moment = _model(vehicle, motion)
    angular_acceleration = angular_moment(vehicle.constants, still, derivative(gyro))
    gyroscopic = angular_moment(vehicle.constants, gyro, still)
    rotors = ModelInputs(np.zeros_like(rpm), derivative(rpm), still, still)
    measured = angular_acceleration + lfilter(half_a_sample, a, gyroscopic, axis=0)
    modelled = lfilter(half_a_sample, a, moment, axis=0) + nominal(vehicle.constants, rotors)[:, 3:]
    specific = lfilter(b, a, signals["specific_force"], axis=0)
    return measured - modelled, specific - lfilter(b, a, force, axis=0)


def _model(vehicle: VehicleParams, motion: ModelInputs) -> tuple[np.ndarray, np.ndarray]:
    """Specific force and moment (n, 3) of the nominal model and the residual."""
    total = nominal(vehicle.constants, motion)
    if vehicle.residual is not None:
        total[:, 2:] += residual_output(vehicle.residual, motion)
    return total[:, :3], total[:, 3:]
