"""The models and the race in NumPy and double precision, written from the equations.

Rows are drones. Ferede et al., arXiv 2311.16948; constants of the Bebop 1 from arXiv 2304.13460.
"""

import numpy as np

MOTOR = {
    "g": 9.81,
    "i_xx": 0.000906,
    "i_yy": 0.001242,
    "i_zz": 0.002054,
    "k_x": 1.07933887e-05,
    "k_y": 9.65250793e-06,
    "k_z": 2.7862899e-05,
    "k_w": 4.36301076e-08,
    "k_h": 0.0625501332,
    "k_p": 1.4119331e-09,
    "k_q": 1.21601884e-09,
    "k_pv": -0.00797101848,
    "k_qv": 0.0129263739,
    "k_r1": 2.57035545e-06,
    "k_r2": 4.10923364e-07,
    "k_rr": 0.000812932607,
    "tau": 0.06,
    "rpm_min": 3000.0,
    "rpm_max": 11000.0,
}
RATE = {
    "g": 9.81,
    "d_x": 0.34,
    "d_y": 0.43,
    "tau_rate": 0.03,
    "tau_thrust": 0.03,
    "p_max": 3.0,
    "q_max": 3.0,
    "r_max": 3.0,
    "thrust_min": 0.0,
    "thrust_max": 15.0,
}
GATES = np.array([[2, -1.5, -1.5], [2, 1.5, -1.5], [-2, 1.5, -1.5], [-2, -1.5, -1.5]], float)
GATE_YAW = np.radians([45.0, 135.0, 225.0, 315.0])

# Columns of a state.
P, V, EULER, RATES = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
RPM, MOMENT, FORCE, THRUST = slice(12, 16), slice(16, 19), slice(19, 22), slice(12, 13)


def elementary(axis: int, angle: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) about one axis, by the right-hand rule."""
    rotation = np.zeros((*np.shape(angle), 3, 3))
    j, k = (axis + 1) % 3, (axis + 2) % 3
    rotation[..., axis, axis] = 1.0
    rotation[..., j, j] = rotation[..., k, k] = np.cos(angle)
    rotation[..., k, j] = np.sin(angle)
    rotation[..., j, k] = -np.sin(angle)
    return rotation


def rotation(euler: np.ndarray) -> np.ndarray:
    """Body to world (n, 3, 3)."""
    roll, pitch, yaw = euler[..., 0], euler[..., 1], euler[..., 2]
    return elementary(2, yaw) @ elementary(1, pitch) @ elementary(0, roll)


def rotate(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return (matrix @ vector[..., None])[..., 0]


def euler_rates(euler: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Solve Omega = roll' e1 + Rx^T (pitch' e2 + Ry^T yaw' e3) for the angles' derivatives."""
    roll_t = np.swapaxes(elementary(0, euler[..., 0]), -1, -2)
    pitch_t = np.swapaxes(elementary(1, euler[..., 1]), -1, -2)
    first = np.broadcast_to(np.eye(3)[0], rates.shape)
    columns = [first, roll_t[..., 1], (roll_t @ pitch_t)[..., 2]]
    return np.linalg.solve(np.stack(columns, axis=-1), rates[..., None])[..., 0]


def network(layers: list, inputs: np.ndarray) -> np.ndarray:
    for index, (kernel, bias) in enumerate(layers):
        inputs = inputs @ kernel + bias
        if index < len(layers) - 1:
            inputs = np.maximum(inputs, 0.0)
    return inputs


def residual_terms(
    residual: dict, rpm: np.ndarray, v_body: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What is added to the body-z specific force and to the moments."""
    low, high = residual["rpm_min"], residual["rpm_max"]
    scaled = (rpm - 0.5 * (low + high)) / (0.5 * (high - low))
    thrust = network(residual["thrust"], np.concatenate([scaled, v_body], -1))[..., 0]
    moment = network(residual["moment"], np.concatenate([scaled, v_body, rates], -1))
    return residual["thrust_sign"] * thrust, moment


def motor_derivative(
    c: dict, state: np.ndarray, command: np.ndarray, residual: dict | None = None
) -> np.ndarray:
    """Time derivative (n, 22) of motor-level states (n, 22) under rpm commands (n, 4)."""
    v, euler, omega, w = state[:, V], state[:, EULER], state[:, RATES], state[:, RPM]
    matrix = rotation(euler)
    v_body = rotate(np.swapaxes(matrix, -1, -2), v)
    vx, vy, vz = v_body.T
    w1, w2, w3, w4 = w.T
    w_dot = (command - w) / c["tau"]
    d1, d2, d3, d4 = w_dot.T
    first, second = w.sum(axis=1), (w**2).sum(axis=1)
    f_z = -c["k_w"] * second - c["k_z"] * vz * first - c["k_h"] * (vx**2 + vy**2)
    force = np.array([-c["k_x"] * vx * first, -c["k_y"] * vy * first, f_z]).T
    p, q, r = omega.T
    m_z = c["k_r1"] * (w2 + w4 - w1 - w3) + c["k_r2"] * (d2 + d4 - d1 - d3) - c["k_rr"] * r
    s1, s2, s3, s4 = (w**2).T
    moment = np.array(
        [
            c["k_p"] * ((s1 + s4) - (s2 + s3)) + c["k_pv"] * vy,
            c["k_q"] * ((s1 + s2) - (s3 + s4)) + c["k_qv"] * vx,
            m_z,
        ]
    ).T
    if residual is not None:
        extra_z, extra_moment = residual_terms(residual, w, v_body, omega)
        force[:, 2] += extra_z
        moment = moment + extra_moment
    inertia = i_x, i_y, i_z = np.array([c["i_xx"], c["i_yy"], c["i_zz"]])
    turning = np.array([(i_z - i_y) * q * r, (i_x - i_z) * r * p, (i_y - i_x) * p * q]).T
    torque = moment + state[:, MOMENT] - turning  # of omega x (inertia omega)
    derivative = np.zeros_like(state)
    derivative[:, P] = v
    derivative[:, V] = rotate(matrix, force + state[:, FORCE]) + [0.0, 0.0, c["g"]]
    derivative[:, EULER] = euler_rates(euler, omega)
    derivative[:, RATES] = torque / inertia
    derivative[:, RPM] = w_dot
    return derivative


def rate_derivative(c: dict, state: np.ndarray, command: np.ndarray) -> np.ndarray:
    """Time derivative (n, 13) of rate-level states under commands (n, 4): p, q, r, thrust."""
    v, euler, omega, thrust = state[:, V], state[:, EULER], state[:, RATES], state[:, 12]
    matrix = rotation(euler)
    v_body = rotate(np.swapaxes(matrix, -1, -2), v)
    force = np.array([-c["d_x"] * v_body[:, 0], -c["d_y"] * v_body[:, 1], -thrust]).T
    derivative = np.zeros_like(state)
    derivative[:, P] = v
    derivative[:, V] = rotate(matrix, force) + [0.0, 0.0, c["g"]]
    derivative[:, EULER] = euler_rates(euler, omega)
    derivative[:, RATES] = (command[:, :3] - omega) / c["tau_rate"]
    derivative[:, 12] = (command[:, 3] - thrust) / c["tau_thrust"]
    return derivative


def wrap(angle: np.ndarray) -> np.ndarray:
    return np.arctan2(np.sin(angle), np.cos(angle))


def observation(
    kind: str,
    c: dict,
    state: np.ndarray,
    target: np.ndarray,
    gates: np.ndarray,
    yaw: np.ndarray,
    spans: tuple[float, ...] = (0.03, 0.03, 0.01, 0.5),
    wrap_next_yaw: bool = True,
) -> np.ndarray:
    """What a policy sees, (n, 24) or (n, 17), of states and the indices of their target gates."""
    following = (target + 1) % len(gates)
    to_gate = np.swapaxes(elementary(2, yaw[target]), -1, -2)
    next_yaw = yaw[following] - yaw[target]
    columns = [
        rotate(to_gate, state[:, P] - gates[target]),
        rotate(to_gate, state[:, V]),
        state[:, 6:8],
        wrap(state[:, 8] - yaw[target])[:, None],
        state[:, RATES],
    ]
    upcoming = [
        rotate(to_gate, gates[following] - gates[target]),
        (wrap(next_yaw) if wrap_next_yaw else next_yaw)[:, None],
    ]
    if kind == "rate":
        low, high = c["thrust_min"], c["thrust_max"]
        return np.concatenate(
            [*columns, -1 + 2 * (state[:, THRUST] - low) / (high - low), *upcoming], 1
        )
    low, high = c["rpm_min"], c["rpm_max"]
    rpm = -1 + 2 * (state[:, RPM] - low) / (high - low)
    known = np.concatenate([state[:, MOMENT], state[:, 21:22]], 1) / np.array(spans)
    return np.concatenate([*columns, rpm, *upcoming, known], 1)


def random_states(kind: str, count: int, seed: int = 0) -> np.ndarray:
    """States over the whole flight envelope, away from the singularity."""
    draw = np.random.default_rng(seed)
    state = np.zeros((count, 22 if kind == "motor" else 13))
    state[:, P] = draw.uniform(-4, 4, (count, 3))
    state[:, V] = draw.uniform(-12, 12, (count, 3))
    state[:, EULER] = draw.uniform(-1, 1, (count, 3)) * [np.pi, 1.45, np.pi]
    state[:, RATES] = draw.uniform(-15, 15, (count, 3))
    if kind == "rate":
        state[:, 12] = draw.uniform(0, 15, count)
        return state
    state[:, RPM] = draw.uniform(3000, 11000, (count, 4))
    state[:, MOMENT] = draw.uniform(-1, 1, (count, 3)) * [0.03, 0.03, 0.01]
    state[:, FORCE] = draw.uniform(-1, 1, (count, 3)) * [0.2, 0.3, 0.5]
    return state


def random_commands(kind: str, count: int, seed: int = 1) -> np.ndarray:
    draw = np.random.default_rng(seed).uniform(-1, 1, (count, 4))
    return 7000 + 4000 * draw if kind == "motor" else [0, 0, 0, 7.5] + [3, 3, 3, 7.5] * draw


def random_residual(sign: float, seed: int = 2) -> dict:
    """Networks of 32 hidden units whose outputs are of the size of the published ones."""
    draw = np.random.default_rng(seed)

    def layers(inputs: int, outputs: int, size: float) -> list:
        return [
            (draw.normal(0, 0.5, (inputs, 32)), draw.normal(0, 0.5, 32)),
            (draw.normal(0, size, (32, outputs)), draw.normal(0, size, outputs)),
        ]

    return {
        "thrust": layers(7, 1, 0.2),
        "moment": layers(10, 3, 0.003),
        "rpm_min": 2500.0,
        "rpm_max": 10500.0,
        "thrust_sign": sign,
    }
