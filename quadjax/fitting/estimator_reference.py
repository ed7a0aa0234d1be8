"""The estimator of ``estimator.py`` once more, over a whole log in float64 NumPy and SciPy.

Written apart from it, signal by signal as the method is described, as a reference for the one that
runs in a simulation and for the C that runs on board.
"""

import numpy as np
from scipy.signal import butter, lfilter

from quadjax.fitting.nominal import Motion, angular_moment, nominal
from quadjax.vehicle.protocol import VehicleParams
from quadjax.vehicle.residual import Layers, Residual


def estimate(
    vehicle: VehicleParams,
    signals: dict[str, np.ndarray],
    sample_rate: float,
    cutoff: float = 8.0,
    explicit_euler: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """External moment and specific force over a log that begins with no disturbance.

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

    gyro, rpm = signals["gyro"], signals["rpm"]
    still = np.zeros_like(gyro)
    motion = Motion(rpm, np.zeros_like(rpm), signals["body_velocity"], gyro)
    force, moment = _model(vehicle, motion)
    angular_acceleration = angular_moment(vehicle.constants, still, derivative(gyro))
    gyroscopic = angular_moment(vehicle.constants, gyro, still)
    rotors = Motion(np.zeros_like(rpm), derivative(rpm), still, still)
    measured = angular_acceleration + lfilter(half_a_sample, a, gyroscopic, axis=0)
    modelled = lfilter(half_a_sample, a, moment, axis=0) + nominal(vehicle.constants, rotors)[:, 3:]
    specific = lfilter(b, a, signals["specific_force"], axis=0)
    return measured - modelled, specific - lfilter(b, a, force, axis=0)


def _model(vehicle: VehicleParams, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Specific force and moment (n, 3) of the nominal model and the residual."""
    force, moment = np.split(nominal(vehicle.constants, motion), 2, axis=1)
    if vehicle.residual is not None:
        extra_force, extra_moment = residual_output(vehicle.residual, motion)
        force[:, 2] += extra_force
        moment += extra_moment
    return force, moment


def residual_output(residual: Residual, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """What the networks add: body-z specific force (n,), m/s^2, and moments (n, 3), N m."""
    low, high = float(residual.rpm_min), float(residual.rpm_max)
    rpm = 2.0 * (motion.rpm - low) / (high - low) - 1.0
    inputs = np.concatenate([rpm, motion.body_velocity], axis=1)
    force = float(residual.thrust_sign) * _network(residual.thrust, inputs)[:, 0]
    return force, _network(residual.moment, np.concatenate([inputs, motion.rates], axis=1))


def _network(layers: Layers, inputs: np.ndarray) -> np.ndarray:
    hidden = inputs
    for index, (kernel, bias) in enumerate(layers):
        hidden = hidden @ np.asarray(kernel, np.float64) + np.asarray(bias, np.float64)
        if index < len(layers) - 1:
            hidden = np.maximum(hidden, 0.0)
    return hidden
