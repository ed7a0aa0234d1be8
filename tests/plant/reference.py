"""The navigation filter once more: dense matrices, rotation matrices, float64 NumPy.

Written from the same sources as ``quadjax.plant``, but apart from it: what the errors' transition
is comes from finite differences of the motion, and the pose is taken in at once, in Joseph's form.
"""

import dataclasses

import numpy as np
from scipy.spatial.transform import Rotation

GRAVITY = np.array([0.0, 0.0, 9.81])
P, V, A, G, F = (slice(3 * i, 3 * i + 3) for i in range(5))


@dataclasses.dataclass
class Nominal:
    position: np.ndarray
    velocity: np.ndarray
    attitude: Rotation
    gyro_bias: np.ndarray
    force_bias: np.ndarray

    def plus(self, error: np.ndarray) -> "Nominal":
        """The true state of an estimate and its fifteen errors."""
        return Nominal(
            self.position + error[P],
            self.velocity + error[V],
            Rotation.from_rotvec(error[A]) * self.attitude,
            self.gyro_bias + error[G],
            self.force_bias + error[F],
        )

    def minus(self, other: "Nominal") -> np.ndarray:
        """The fifteen errors that lead from another state to this one."""
        return np.concatenate(
            [
                self.position - other.position,
                self.velocity - other.velocity,
                (self.attitude * other.attitude.inv()).as_rotvec(),
                self.gyro_bias - other.gyro_bias,
                self.force_bias - other.force_bias,
            ]
        )


def advance(state: Nominal, gyro: np.ndarray, force: np.ndarray, step: float) -> Nominal:
    """One step with mean rates and mean specific force."""
    rates = gyro - state.gyro_bias
    middle = state.attitude * Rotation.from_rotvec(0.5 * step * rates)
    acceleration = middle.apply(force - state.force_bias) + GRAVITY
    return dataclasses.replace(
        state,
        position=state.position + step * state.velocity + 0.5 * step**2 * acceleration,
        velocity=state.velocity + step * acceleration,
        attitude=state.attitude * Rotation.from_rotvec(step * rates),
    )


def transition(state: Nominal, gyro: np.ndarray, force: np.ndarray, step: float) -> np.ndarray:
    """How the errors go on, (15, 15), by central differences."""
    size, columns = 1e-5, []
    for unit in np.eye(15):
        ends = [advance(state.plus(s * size * unit), gyro, force, step) for s in (1.0, -1.0)]
        columns.append(ends[0].minus(ends[1]) / (2.0 * size))
    return np.array(columns).T


def noise_input(state: Nominal, gyro: np.ndarray, force: np.ndarray, step: float) -> np.ndarray:
    """How noise of gyro and accelerometer enters the errors, (15, 6), by central differences."""
    size, columns = 1e-5, []
    for unit in np.eye(6):
        ends = [
            advance(state, gyro + s * size * unit[:3], force + s * size * unit[3:], step)
            for s in (1.0, -1.0)
        ]
        columns.append(ends[0].minus(ends[1]) / (2.0 * size))
    return np.array(columns).T


def predict(
    state: Nominal,
    covariance: np.ndarray,
    gyro: np.ndarray,
    force: np.ndarray,
    step: float,
    densities: dict[str, float],
) -> tuple[Nominal, np.ndarray]:
    """Estimate and covariance one step later; densities are variances per second."""
    f, g = transition(state, gyro, force, step), noise_input(state, gyro, force, step)
    white = np.repeat([densities["gyro"], densities["force"]], 3) / step
    walks = np.zeros(15)
    walks[G], walks[F] = densities["gyro_walk"] * step, densities["force_walk"] * step
    grown = f @ covariance @ f.T + g @ np.diag(white) @ g.T + np.diag(walks)
    return advance(state, gyro, force, step), grown


def correct(
    state: Nominal,
    covariance: np.ndarray,
    position: np.ndarray,
    attitude: Rotation,
    variances: tuple[float, float],
) -> tuple[Nominal, np.ndarray]:
    """Take in a pose: six measurements at once, Joseph's form."""
    h = np.zeros((6, 15))
    h[:3, P] = h[3:, A] = np.eye(3)
    noise = np.diag(np.repeat(variances, 3))
    turned = (attitude * state.attitude.inv()).as_rotvec()
    innovation = np.concatenate([position - state.position, turned])
    gain = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + noise)
    keep = np.eye(15) - gain @ h
    after = keep @ covariance @ keep.T + gain @ noise @ gain.T
    return state.plus(gain @ innovation), after
