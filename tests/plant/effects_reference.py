"""The plant's effects in NumPy and double precision, written from their sources."""

import numpy as np


def advance_loss(c: dict, r: dict, climb: np.ndarray) -> np.ndarray:
    """Lost specific force of four rotors with C_T = C_T0 (1 - c J^2), J = V / (n D)."""
    n, diameter = 120.0, 2.0 * r["radius"]  # any speed, turns/s: the loss does not depend on it
    advance = np.maximum(climb, 0.0) / (n * diameter)
    thrust = 4.0 * c["k_w"] * (60.0 * n) ** 2
    return thrust * r["advance_loss"] * advance**2


def ground_ratio(r: dict, altitude: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Cheeseman and Bennett: thrust near the ground over thrust far from it."""
    near = r["ground"] * (r["radius"] / (4.0 * (altitude + r["height"]))) ** 2
    return 1.0 / (1.0 - near / (1.0 + (speed / r["induced"]) ** 2))


def flapping(c: dict, r: dict, rpm: np.ndarray, v: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Moment of tilted discs: a force across at the discs' height, and the hubs' stiffness."""
    newtons = r["mass"] * c["k_w"] * (rpm**2).sum(axis=1)
    omega = rpm.mean(axis=1) * 2.0 * np.pi / 60.0
    lag = 16.0 / (r["lock_number"] * omega)
    back = r["flap_gain"] * v[:, 0] / (omega * r["radius"]) - lag * rates[:, 1]
    left = r["flap_gain"] * v[:, 1] / (omega * r["radius"]) + lag * rates[:, 0]
    force = newtons[:, None] * np.stack([-back, -left, 0 * back], axis=1)
    arm = np.array([0.0, 0.0, -r["height"]])  # z is down
    hubs = r["hub_stiffness"] * np.stack([-left, back, 0 * back], axis=1)
    return np.cross(arm, force) + hubs


def gyroscopic(c: dict, rpm: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Minus Omega x h, with the momentum h of four rotors that turn in alternating directions."""
    inertia = c["k_r2"] * 60.0 / (2.0 * np.pi)  # kg m^2, of the reaction to acceleration
    direction = np.array([1.0, -1.0, 1.0, -1.0])  # about body z, down
    omega = rpm * 2.0 * np.pi / 60.0
    momentum = np.zeros((len(rpm), 3))
    momentum[:, 2] = inertia * (omega * direction).sum(axis=1)
    return -np.cross(rates, momentum)


def second_order(tau: float, lag: float, time: np.ndarray) -> np.ndarray:
    """Step response of 1 / ((a s + 1)(b s + 1)) with a + b = tau and a b = tau lag."""
    root = np.sqrt(tau * tau - 4.0 * tau * lag + 0j)
    a, b = 0.5 * (tau + root), 0.5 * (tau - root)
    return (1.0 - (a * np.exp(-time / a) - b * np.exp(-time / b)) / (a - b)).real


def dryden_power(deviation: float, length: float, speed: float, omega: np.ndarray, along: bool):
    """One-sided spectrum, (m/s)^2/(rad/s), of MIL-F-8785C's filters with its white noise."""
    part = (length * omega / speed) ** 2
    if along:
        return deviation**2 * 2.0 * length / (np.pi * speed) / (1.0 + part)
    return deviation**2 * length / (np.pi * speed) * (1.0 + 3.0 * part) / (1.0 + part) ** 2
