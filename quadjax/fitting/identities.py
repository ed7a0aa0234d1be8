"""What the quantities of a flight log must fulfill together: kinematics and Newton's law.

Each identity is a residual, zero but for noise and biases. Arrays have the samples and the axes
last, (.., n, 3), and hypotheses before them.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from quadjax.fitting.formats import FROM_FRD, TO_NED
from quadjax.fitting.signals import low_pass
from quadjax.vehicle.airframe import GRAVITY_M_S2

MOTION_BAND_HZ = 5.0  # of the motion that is compared
LEAST_RATE_HZ = 50.0  # least sample rate of the comparison
EDGE_S = 0.3  # left out at either end, where the filters distort the signals
SHORTEST_S = 1.0  # least duration without the ends
LONGEST_S = 60.0  # longest part of a flight that is compared
SETTLING_S = 1.0  # time constant with which the direction of gravity is followed
# Samples of filtered noise are not independent, nor are all errors noise.
INDEPENDENT = 0.5
AXES, MOTORS = (0, 1, 2), (0, 1, 2, 3)
VECTORS = ("gyro", "acceleration", "body_velocity", "world_velocity", "position")

Arrays = Mapping[str, np.ndarray]


class Change(NamedTuple):
    """What may be wrong with some columns of a quantity."""

    columns: tuple[int, ...] = ()
    text: str = ""  # after the names of the columns; {0} is the name of the quantity's first one
    allowed: bool = False
    matrix: np.ndarray = np.eye(3)  # that corrects the columns
    delay: float = 0.0  # s, by which they are late
    order: tuple[int, ...] = MOTORS  # column of each motor
    spin: float = 1.0  # -1 for propellers that turn the other way
    scale: float = 1.0  # of all columns, that corrects them
    unlikely: float = 0.0  # log-likelihood that its evidence must exceed besides


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
        """Signals (.., m, k) below ``MOTION_BAND_HZ``."""
        return low_pass(values, self.rate, min(MOTION_BAND_HZ, 0.4 * self.rate), axis=-2)


def filter_signals(quantities: Arrays, flying: np.ndarray, rate: float) -> Signals | None:
    """The signals of quantities (n, k), sampled at Hz; None for a flight that is too short."""
    airborne = np.flatnonzero(flying)
    if not len(airborne):
        return None
    span = slice(airborne[0], min(airborne[-1] + 1, airborne[0] + round(LONGEST_S * rate)))
    every = max(1, int(rate / LEAST_RATE_HZ))
    samples = np.arange(0, span.stop - span.start, every)
    edge = max(round(EDGE_S * rate / every), 1)
    inner = flying[span][samples]
    inner[:edge] = inner[len(inner) - edge :] = False
    if np.count_nonzero(inner) <= SHORTEST_S * rate / every:
        return None
    values = {name: x[span] for name, x in quantities.items()}
    if every > 1:
        sections = butter(4, 0.4 / every, fs=1.0, output="sos")
        values = {name: sosfiltfilt(sections, x, axis=0) for name, x in values.items()}
    return Signals(values, samples, inner, 1.0 / rate, rate / every)


class Identity(NamedTuple):
    """A residual (.., n, k) of quantities, zero but for noise."""

    residual: Callable[[Arrays, float], np.ndarray]  # of the quantities and the sample rate, Hz
    linear: tuple[str, ...]  # quantities on which it depends linearly
    nonlinear: tuple[str, ...]  # others on which it depends
    bias: float  # standard deviation of its mean that sensors and filters explain
    noise: float  # standard deviation below which it is zero
    band: float = MOTION_BAND_HZ  # Hz, of its noise; 0 where only its mean counts


def derivative(values: np.ndarray, rate: float) -> np.ndarray:
    """Time derivative along the last axis but one, by fourth-order differences; 0 at the ends."""
    near = values[..., 3:-1, :] - values[..., 1:-3, :]
    far = values[..., 4:, :] - values[..., :-4, :]
    slope = np.zeros_like(values)
    slope[..., 2:-2, :] = (8.0 * near - far) * (rate / 12.0)
    return slope


def euler_matrices(angles: np.ndarray) -> np.ndarray:
    """Rotations (.., 3, 3) by roll, pitch and yaw (.., 3), rad, as of ``Rotation`` with "ZYX"."""
    (sin_r, sin_p, sin_y), (cos_r, cos_p, cos_y) = (
        np.moveaxis(function(angles), -1, 0) for function in (np.sin, np.cos)
    )
    matrix = np.empty((*angles.shape, 3))
    matrix[..., 0, 0] = cos_y * cos_p
    matrix[..., 0, 1] = cos_y * sin_p * sin_r - sin_y * cos_r
    matrix[..., 0, 2] = cos_y * sin_p * cos_r + sin_y * sin_r
    matrix[..., 1, 0] = sin_y * cos_p
    matrix[..., 1, 1] = sin_y * sin_p * sin_r + cos_y * cos_r
    matrix[..., 1, 2] = sin_y * sin_p * cos_r - cos_y * sin_r
    matrix[..., 2, 0] = -sin_p
    matrix[..., 2, 1] = cos_p * sin_r
    matrix[..., 2, 2] = cos_p * cos_r
    return matrix


def rotate(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors (.., n, 3) by matrices (.., n, 3, 3)."""
    return np.einsum("...ij,...j->...i", matrix, vector)


def gyro_residual(q: Arrays, rate: float) -> np.ndarray:
    """Gyro less the rates of the attitude, rad/s."""
    attitude = q["attitude"]
    flat = attitude.reshape(*attitude.shape[:-2], 9)
    slope = derivative(flat, rate).reshape(attitude.shape)
    turn = np.einsum("...ji,...jk->...ik", attitude, slope)
    return q["gyro"] - np.stack([turn[..., 2, 1], turn[..., 0, 2], turn[..., 1, 0]], axis=-1)


def velocity_residual(q: Arrays, rate: float) -> np.ndarray:
    """World or body velocity less the derivative of the position, m/s."""
    slope = derivative(q["position"], rate)
    if "world_velocity" in q:
        return q["world_velocity"] - slope
    return q["body_velocity"] - rotate(q["attitude"].swapaxes(-1, -2), slope)


def accelerometer_residual(q: Arrays, rate: float) -> np.ndarray:
    """Specific force less that of the velocity's derivative and gravity, body axes, m/s^2."""
    world = "world_velocity" in q
    velocity = q["world_velocity"] if world else rotate(q["attitude"], q["body_velocity"])
    slope = derivative(velocity, rate) - GRAVITY_M_S2 * np.eye(3)[2]
    return q["acceleration"] - rotate(q["attitude"].swapaxes(-1, -2), slope)


def gravity(q: Arrays, rate: float) -> np.ndarray:
    """Gravity in body axes by body velocity, gyro and specific force, (.., n, 3), m/s^2."""
    velocity = q["body_velocity"]
    return derivative(velocity, rate) + np.cross(q["gyro"], velocity) - q["acceleration"]


def gravity_residual(q: Arrays, rate: float) -> np.ndarray:
    """Gravity less its past, turned by the gyro, m/s^2."""
    measured = gravity(q, rate)
    turns = np.broadcast_to(q["gyro"] / rate, measured.shape)
    sizes = np.sqrt(1.0 + (turns**2).sum(axis=-1, keepdims=True))  # no turn makes gravity longer
    residual = np.empty_like(measured)
    turned = measured[..., : round(rate), :].mean(axis=-2)
    for i in range(measured.shape[-2]):
        turned = (turned - np.cross(turns[..., i, :], turned)) / sizes[..., i, :]
        residual[..., i, :] = measured[..., i, :] - turned
        turned = turned + residual[..., i, :] / (SETTLING_S * rate)
    return residual


def gravity_size_residual(q: Arrays, rate: float) -> np.ndarray:
    """Gravity along its direction by the columns as logged, less 9.81 m/s^2, (.., n, 1)."""
    return (gravity(q, rate) * q["down"]).sum(axis=-1, keepdims=True) - GRAVITY_M_S2


class Evidence:
    """A log's signals and the identities that they have to fulfill."""

    def __init__(
        self, signals: Signals, names: Mapping[str, object], frames: tuple[str, str]
    ) -> None:
        """The identities of the quantities that a log has; ``frames`` are its body and world."""
        self.signals, self.frames = signals, frames
        quantities = {name: signals.at(name) for name in VECTORS if name in signals.values}
        self.quantities: Arrays = quantities  # (m, 3) as logged, the attitude (m, 3, 3)
        if "quaternion" not in signals.values:
            measured = gravity(quantities, signals.rate)
            down = measured - gravity_residual(quantities, signals.rate)
            size = np.linalg.norm(down, axis=1, keepdims=True)
            quantities["down"] = down / np.maximum(size, 1e-9)
            used = ("acceleration", "body_velocity")
            self.identities = [
                Identity(gravity_residual, used, ("gyro",), bias=0.5, noise=0.05),
                Identity(gravity_size_residual, used, (), bias=0.5, noise=0.05, band=0.0),
            ]
            return
        quantities["attitude"] = Rotation.from_quat(signals.at("quaternion")).as_matrix()
        velocity = "world_velocity" if "world_velocity" in names else "body_velocity"
        self.identities = [
            Identity(gyro_residual, ("gyro",), ("attitude",), bias=0.1, noise=0.01),
            Identity(
                accelerometer_residual,
                ("acceleration", velocity),
                ("attitude",),
                bias=0.5,
                noise=0.05,
            ),
        ]
        if "position" in quantities:
            attitude = ("attitude",) if velocity == "body_velocity" else ()
            used = (velocity, "position")
            self.identities.append(
                Identity(velocity_residual, used, attitude, bias=0.3, noise=0.02)
            )

    def laws_of(self, quantity: str) -> list[Identity]:
        """The identities that a quantity is part of."""
        return [law for law in self.identities if quantity in law.linear + law.nonlinear]

    def gains(self, quantity: str, changes: Sequence[Change]) -> np.ndarray:
        """Gains (h,) of log-likelihood by changes of a quantity; 0 if it is part of no identity."""
        laws, rows = self.laws_of(quantity), [Change(), *changes]
        if not laws:
            return np.zeros(len(changes))
        likelihoods = np.zeros(len(rows))
        matrices = np.stack([change.matrix for change in rows])
        late = np.array([change.delay != 0.0 for change in rows])
        every = np.ones(len(rows), bool)
        nonlinear = any(quantity in identity.nonlinear for identity in laws)
        evaluated = np.flatnonzero(every if nonlinear else late)
        corrected = self._corrected(quantity, [rows[i] for i in evaluated.tolist()])
        # A residual gains likelihood merely because a correction makes it smaller.
        shrinking = np.maximum(-np.log(np.linalg.norm(matrices, axis=2)), 0.0).sum(axis=1)
        for identity in laws:
            selected = late if quantity in identity.linear else every
            mean, square = np.empty((2, len(rows), 1 if identity.band == 0.0 else 3))
            if selected.any():
                residual = self._residual(identity, quantity, corrected[selected[evaluated]])
                mean[selected], square[selected] = residual.mean(axis=1), (residual**2).mean(axis=1)
            if not selected.all():
                moments = self._linear_moments(identity, quantity, matrices[~selected])
                mean[~selected], square[~selected] = moments
            count = self.signals.count(identity.band)
            variance = np.maximum(square - mean**2, 0.0) + identity.noise**2
            axes = -0.5 * count * np.log(variance) - 0.5 * (mean / identity.bias) ** 2
            likelihoods += axes.sum(axis=1) - count * shrinking
        return likelihoods[1:] - likelihoods[0]

    def gains_unrelated(self, quantity: str) -> np.ndarray:
        """Gains (3,) of log-likelihood if a column of a vector contains something else.

        Then the residual is larger than each of its two independent parts, that of the column and
        that of all other columns. Otherwise it is smaller than one of them, unless both are noise.
        """
        gains, values = np.zeros(3), self.quantities[quantity]
        stack = np.stack([values, *(values * (np.arange(3) != i) for i in AXES)])
        for identity in self.identities:
            if quantity in identity.linear:
                whole, *others = self._residual(identity, quantity, stack)
                for i, rest in enumerate(others):
                    sizes = [x.var(axis=0) + identity.noise**2 for x in (whole, rest, whole - rest)]
                    ratio = sizes[0] / np.maximum(sizes[1], sizes[2])
                    gains[i] += 0.5 * self.signals.count(identity.band) * np.log(ratio).sum()
        return gains

    def _residual(self, identity: Identity, quantity: str, stack: np.ndarray) -> np.ndarray:
        """Residuals (h, i, k) of the inner samples for a quantity's values (h, m, ..)."""
        quantities, signals = {**self.quantities, quantity: stack}, self.signals
        residual = identity.residual(quantities, signals.rate)
        return signals.low_pass(residual)[:, signals.inner]

    def _linear_moments(
        self, identity: Identity, quantity: str, matrices: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Means and mean squares (h, k) of a residual under matrices (h, 3, 3) on a quantity.

        The residual is one without the quantity, plus one for each element of the matrix.
        """
        values = self.quantities[quantity]
        stack = np.zeros((10, *values.shape))
        for i, k in itertools.product(AXES, AXES):
            stack[1 + 3 * i + k, :, i] = values[:, k]
        parts = self._residual(identity, quantity, stack)
        parts[1:] -= parts[0]
        gram = np.einsum("hni,gni->ihg", parts, parts, optimize=True) / parts.shape[1]
        elements = np.pad(matrices.reshape(-1, 9), ((0, 0), (1, 0)), constant_values=1.0)
        return elements @ parts.mean(axis=1), ((elements @ gram) * elements).sum(axis=2).T

    def _corrected(self, quantity: str, changes: Sequence[Change]) -> np.ndarray:
        """A quantity after each change, (h, m, 3), or (h, m, 3, 3) of the attitude."""
        at, form = self.signals.at, quantity
        if quantity == "attitude":
            form = "euler" if "euler" in self.signals.values else "quaternion"
        values = np.stack([at(form, change.delay) for change in changes])
        for row, change in zip(values, changes, strict=True):
            if len(change.columns) == 1 and change.delay:
                others = [i for i in AXES if i not in change.columns]
                row[:, others] = at(form)[:, others]
        matrices = np.stack([change.matrix for change in changes])
        values[..., :3] = values[..., :3] @ matrices.swapaxes(1, 2)
        if quantity != "attitude":
            return values
        if form == "quaternion":
            flat = Rotation.from_quat(values.reshape(-1, 4)).as_matrix()
            return flat.reshape(*values.shape[:2], 3, 3)
        body, world = self.frames
        return TO_NED[world].as_matrix() @ euler_matrices(values) @ FROM_FRD[body].as_matrix()
