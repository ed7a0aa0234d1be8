"""The racing models in NumPy and double precision, as they are published.

Rows are drones: position, velocity, quaternion (w, x, y, z), rates, rotors. Published rotors are
1 rear-right, 2 front-right, 3 rear-left, 4 front-left; ``PUBLISHED`` picks them from the project's
order. Racing quadcopter: arXiv 2504.21586; A2RL: arXiv 2601.15222.
"""

import numpy as np

P, V, Q, RATES, ROTORS = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13), slice(13, 17)
PUBLISHED = [2, 1, 3, 0]

FIVE_INCH = {
    "g": 9.81,
    "k_w": 2.49e-06,
    "k_x": 4.85e-05,
    "k_y": 7.28e-05,
    "k_p": [6.55e-05, 6.61e-05, 6.36e-05, 6.67e-05],
    "k_q": [5.28e-05, 5.86e-05, 5.05e-05, 5.89e-05],
    "k_r": [1.07e-02] * 4,
    "k_rd": [1.97e-03] * 4,
    "w_min": 238.49,
    "w_max": 3295.50,
    "k": 0.95,
    "tau": 0.04,
}
THREE_INCH = FIVE_INCH | {
    "k_w": 6.00e-07,
    "k_x": 3.36e-05,
    "k_y": 3.73e-05,
    "k_p": [2.57e-05, 2.51e-05, 2.72e-05, 2.00e-05],
    "k_q": [9.10e-06, 9.96e-06, 1.17e-05, 8.21e-06],
    "k_r": [9.64e-03] * 4,
    "k_rd": [1.14e-03] * 4,
    "w_min": 305.40,
    "w_max": 4887.57,
    "k": 0.84,
}
A2RL = FIVE_INCH | {
    "k_w": 1.55e-06,
    "k_x": 5.37e-05,
    "k_y": 5.37e-05,
    "k_p": [4.99e-05, 3.78e-05, 4.82e-05, 3.83e-05],
    "k_q": [2.05e-05, 2.46e-05, 2.02e-05, 2.57e-05],
    "k_r": [0.00338] * 4,
    "k_rd": [0.000324] * 4,
    "k_angle": 3.14514,
    "k_hor": 7.245,
    "k_v2": 0.0,
    "k_x2": 0.0041,
    "k_y2": 0.0151,
    "j_x": -0.89,
    "j_y": 0.96,
    "j_z": -0.34,
    "rotor_radius": 0.0485775,
    "w_min": 341.75,
    "w_max": 3100.0,
    "k": 0.5,
    "tau": 0.03,
}


def rotation(q: np.ndarray) -> np.ndarray:
    """Body to world (n, 3, 3): ``I + 2 w [v] + 2 [v]^2`` with the vector part's cross matrix."""
    w, v = q[:, 0, None, None], cross_matrix(q[:, 1:])
    return np.eye(3) + 2 * w * v + 2 * v @ v


def cross_matrix(v: np.ndarray) -> np.ndarray:
    zero = np.zeros(len(v))
    x, y, z = v.T
    rows = [[zero, -z, y], [z, zero, -x], [-y, x, zero]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _kinematics(state: np.ndarray, force: np.ndarray, spin: np.ndarray, g: float) -> np.ndarray:
    derivative = np.zeros_like(state)
    derivative[:, P] = state[:, V]
    derivative[:, V] = np.einsum("nij,nj->ni", rotation(state[:, Q]), force) + [0, 0, g]
    w, v, half = state[:, 6:7], state[:, 7:10], 0.5 * state[:, RATES]
    derivative[:, 6] = -np.sum(v * half, axis=1)
    derivative[:, 7:10] = w * half + np.cross(v, half)
    derivative[:, RATES] = spin
    return derivative


def _body_velocity(state: np.ndarray) -> np.ndarray:
    return np.einsum("nji,nj->ni", rotation(state[:, Q]), state[:, V])


def racing_derivative(c: dict, state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Time derivative (n, 17) of states (n, 17) under commands (n, 4) in [0, 1]."""
    w, u = state[:, ROTORS][:, PUBLISHED], command[:, PUBLISHED]
    steady = (c["w_max"] - c["w_min"]) * np.sqrt(c["k"] * u**2 + (1 - c["k"]) * u) + c["w_min"]
    d = (steady - w) / c["tau"]
    v, omega = _body_velocity(state), state[:, RATES]
    total, squares = w.sum(axis=1), (w**2).sum(axis=1)
    thrust = c["k_w"] * squares
    drag = np.stack([-c["k_x"] * v[:, 0] * total, -c["k_y"] * v[:, 1] * total], -1)
    k_p, k_q, k_r, k_rd = c["k_p"], c["k_q"], c["k_r"], c["k_rd"]
    spin = np.stack(
        [
            (w**2) @ (k_p * np.array([-1, -1, 1, 1])),
            (w**2) @ (k_q * np.array([-1, 1, -1, 1])),
            w @ (k_r * np.array([-1, 1, 1, -1])) + d @ (k_rd * np.array([-1, 1, 1, -1])),
        ],
        -1,
    )
    if "k_angle" in c:
        tip = c["rotor_radius"] * total / 4
        alpha = np.arctan2(v[:, 2], tip)
        mu = np.arctan2(v[:, 0] ** 2 + v[:, 1] ** 2, tip**2)
        thrust = thrust * (1 + c["k_angle"] * alpha + c["k_hor"] * mu)
        thrust = thrust + c["k_v2"] * v[:, 2] * np.abs(v[:, 2])
        drag = drag - [c["k_x2"], c["k_y2"]] * v[:, :2] * np.abs(v[:, :2])
        p, q, r = omega.T
        spin = spin + np.stack([c["j_x"] * q * r, c["j_y"] * p * r, c["j_z"] * p * q], -1)
    derivative = _kinematics(state, np.column_stack([drag, -thrust]), spin, c["g"])
    derivative[:, ROTORS] = d[:, np.argsort(PUBLISHED)]
    return derivative


def random_states(low: float, high: float, count: int, seed: int = 0) -> np.ndarray:
    """States at any attitude, with rotors between ``low`` and ``high``."""
    draw = np.random.default_rng(seed)
    state = np.zeros((count, 17))
    state[:, P] = draw.uniform(-4, 4, (count, 3))
    state[:, V] = draw.uniform(-20, 20, (count, 3))
    q = draw.normal(size=(count, 4))
    state[:, Q] = q / np.linalg.norm(q, axis=1, keepdims=True)
    state[:, RATES] = draw.uniform(-15, 15, (count, 3))
    state[:, ROTORS] = draw.uniform(low, high, (count, 4))
    return state
