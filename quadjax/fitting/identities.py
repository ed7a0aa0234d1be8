"""What the quantities of a flight log must fulfill together: kinematics and Newton's law.

Each identity is a residual, zero but for noise and biases. Arrays have the samples and the axes
last, (.., n, 3), and hypotheses before them.
"""

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

GRAVITY = np.array([0.0, 0.0, 9.81])  # m/s^2, world
BAND = 5.0  # Hz, of the motion that is compared
RATE = 50.0  # Hz, least sample rate of the comparison
EDGE = 0.3  # s, left out at either end, where the filters distort the signals
SHORTEST = 1.0  # s, least duration without the ends
SECONDS = 60.0  # longest part of a flight that is compared
SETTLING = 1.0  # s, time constant with which the direction of gravity is followed
# Samples of filtered noise are not independent, nor are all errors noise.
INDEPENDENT = 0.5

Arrays = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class Signals:
    """A flight's quantities (n, k), evenly sampled, and the samples that are compared."""

    values: dict[str, np.ndarray]
    samples: np.ndarray  # (m,) indices of every k-th sample
    inner: np.ndarray  # (m,) whether in flight and not at an end
    step: float  # s, between samples of ``values``
    rate: float  # Hz, of the samples that are compared

    def at(self, quantity: str, delay: float = 0.0) -> np.ndarray:
        """A quantity (m, k) as if it were late by ``delay`` s; the ends are held."""
        values = self.values[quantity]
        return values[np.clip(self.samples + round(delay / self.step), 0, len(values) - 1)]

    def count(self, band: float) -> float:
        """Number of independent samples of noise in a band, Hz."""
        return INDEPENDENT * 2.0 * band * np.count_nonzero(self.inner) / self.rate

    def low_pass(self, values: np.ndarray) -> np.ndarray:
        """Signals (.., m, k) below ``BAND``."""
        return sosfiltfilt(_below(min(BAND, 0.4 * self.rate), self.rate), values, axis=-2)


@functools.cache
def _below(band: float, rate: float) -> np.ndarray:
    """Sections of a low-pass filter; both in Hz."""
    return butter(2, band, fs=rate, output="sos")


def signals_of(quantities: Arrays, flying: np.ndarray, rate: float) -> Signals | None:
    """The signals of quantities (n, k), sampled at Hz; None for a flight that is too short."""
    airborne = np.flatnonzero(flying)
    if not len(airborne):
        return None
    part = slice(airborne[0], min(airborne[-1] + 1, airborne[0] + round(SECONDS * rate)))
    every = max(1, int(rate / RATE))
    samples = np.arange(0, part.stop - part.start, every)
    edge = round(EDGE * rate / every)
    inner = flying[part][samples]
    inner[: max(edge, 1)] = inner[len(inner) - max(edge, 1) :] = False
    if np.count_nonzero(inner) <= SHORTEST * rate / every:
        return None
    sections = butter(4, 0.4 / every, fs=1.0, output="sos") if every > 1 else None
    values = {
        name: sosfiltfilt(sections, x[part], axis=0) if every > 1 else x[part]
        for name, x in quantities.items()
    }
    return Signals(values, samples, inner, 1.0 / rate, rate / every)


@dataclass(frozen=True)
class Identity:
    """A residual (.., n, k) of quantities, zero but for noise.

    Attributes:
        residual: of the quantities by name and the sample rate.
        uses: quantities that it depends on.
        nonlinear: those of them on which it does not depend linearly.
        bias: standard deviation of its mean that sensors and filters explain.
        noise: standard deviation below which it is zero.
        band: Hz, of its noise; 0 where only its mean counts.
    """

    residual: Callable[[Arrays, float], np.ndarray]
    uses: tuple[str, ...]
    nonlinear: tuple[str, ...]
    bias: float
    noise: float
    band: float = BAND


def derivative(values: np.ndarray, rate: float) -> np.ndarray:
    """Time derivative along the last axis but one, by fourth-order differences; 0 at the ends."""
    near = values[..., 3:-1, :] - values[..., 1:-3, :]
    far = values[..., 4:, :] - values[..., :-4, :]
    slope = np.zeros_like(values)
    slope[..., 2:-2, :] = (8.0 * near - far) * (rate / 12.0)
    return slope


def rotate(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (.., n, 3) by matrices (.., n, 3, 3)."""
    return np.einsum("...ij,...j->...i", matrix, vector)


def rotate_back(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (.., n, 3) by the transposes of matrices (.., n, 3, 3)."""
    return np.einsum("...ji,...j->...i", matrix, vector)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross products of vectors (.., 3)."""
    x = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    y = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    z = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return np.stack([x, y, z], axis=-1)


def matrices_of_quaternions(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (.., 3, 3) of quaternions (.., 4) of any length, scalar last."""
    x, y, z, w = np.moveaxis(quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternions_of_angles(angles: np.ndarray) -> np.ndarray:
    """Quaternions (.., 4), scalar last, of roll, pitch and yaw (.., 3), rad."""
    a, b, c = np.moveaxis(np.cos(0.5 * angles), -1, 0)
    x, y, z = np.moveaxis(np.sin(0.5 * angles), -1, 0)
    return np.stack(
        [
            x * b * c - a * y * z,
            a * y * c + x * b * z,
            a * b * z - x * y * c,
            a * b * c + x * y * z,
        ],
        axis=-1,
    )


def turning(q: Arrays, rate: float) -> np.ndarray:
    """Gyro less the rates of the attitude, rad/s."""
    attitude = q["attitude"]
    flat = attitude.reshape(*attitude.shape[:-2], 9)
    slope = derivative(flat, rate).reshape(attitude.shape)
    turn = np.einsum("...ji,...jk->...ik", attitude, slope)
    return q["gyro"] - np.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], axis=-1)


def moving(q: Arrays, rate: float) -> np.ndarray:
    """World velocity less the derivative of the position, m/s."""
    return q["world_velocity"] - derivative(q["position"], rate)


def moving_body(q: Arrays, rate: float) -> np.ndarray:
    """Body velocity less the derivative of the position, m/s."""
    return q["body_velocity"] - rotate_back(q["attitude"], derivative(q["position"], rate))


def forcing(q: Arrays, rate: float) -> np.ndarray:
    """Specific force less that of the world velocity's derivative and gravity, body axes, m/s^2."""
    slope = derivative(q["world_velocity"], rate)
    return q["acceleration"] - rotate_back(q["attitude"], slope - GRAVITY)


def forcing_body(q: Arrays, rate: float) -> np.ndarray:
    """The same from the body velocity."""
    world = rotate(q["attitude"], q["body_velocity"])
    return forcing({**q, "world_velocity": world}, rate)


def gravity(q: Arrays, rate: float) -> np.ndarray:
    """Gravity in body axes by body velocity, gyro and specific force, (.., n, 3), m/s^2."""
    velocity = q["body_velocity"]
    slope = derivative(velocity, rate) + cross(q["gyro"], velocity)
    return slope - q["acceleration"]


def turning_gravity(q: Arrays, rate: float) -> np.ndarray:
    """Gravity less its past, turned by the gyro, m/s^2."""
    measured = gravity(q, rate)
    turns = np.broadcast_to(q["gyro"] / rate, measured.shape)
    sizes = np.sqrt(1.0 + (turns**2).sum(axis=-1, keepdims=True))  # no turn makes gravity longer
    residual = np.empty_like(measured)
    turned = measured[..., : round(rate), :].mean(axis=-2)
    for i in range(measured.shape[-2]):
        turned = (turned - cross(turns[..., i, :], turned)) / sizes[..., i, :]
        residual[..., i, :] = measured[..., i, :] - turned
        turned = turned + residual[..., i, :] / (SETTLING * rate)
    return residual


def gravity_size(q: Arrays, rate: float) -> np.ndarray:
    """Gravity along its direction by the columns as logged, less 9.81 m/s^2, (.., n, 1)."""
    along = (gravity(q, rate) * q["down"]).sum(axis=-1, keepdims=True)
    return along - GRAVITY[2]


TURNING = Identity(turning, ("gyro", "attitude"), ("attitude",), bias=0.1, noise=0.01)
MOVING = Identity(moving, ("world_velocity", "position"), (), bias=0.3, noise=0.02)
MOVING_BODY = Identity(
    moving_body, ("body_velocity", "position", "attitude"), ("attitude",), bias=0.3, noise=0.02
)
FORCING = Identity(
    forcing, ("acceleration", "world_velocity", "attitude"), ("attitude",), bias=0.5, noise=0.05
)
FORCING_BODY = Identity(
    forcing_body, ("acceleration", "body_velocity", "attitude"), ("attitude",), bias=0.5, noise=0.05
)
TURNING_GRAVITY = Identity(
    turning_gravity, ("gyro", "acceleration", "body_velocity"), ("gyro",), bias=0.5, noise=0.05
)
GRAVITY_SIZE = Identity(
    gravity_size, ("acceleration", "body_velocity"), (), bias=0.5, noise=0.05, band=0.0
)


def log_likelihood(
    identity: Identity, mean: np.ndarray, square: np.ndarray, count: float
) -> np.ndarray:
    """Of residuals with means and mean squares (.., k), each axis with its noise."""
    variance = np.maximum(square - mean**2, 0.0) + identity.noise**2
    likelihood = -0.5 * count * np.log(variance) - 0.5 * (mean / identity.bias) ** 2
    return likelihood.sum(axis=-1)
