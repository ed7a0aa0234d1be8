"""Log-likelihoods of the order, spin and delay of a flight's motors.

The rotors' speeds cause the angular accelerations, by the nominal model with non-negative
constants, and follow their commands. Low frequencies are left out of the first, because there the
rotors' moments balance others that the model lacks.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from quadjax.fitting.changes import Change
from quadjax.fitting.identities import BAND as MOTION
from quadjax.fitting.identities import Signals, derivative
from quadjax.fitting.nominal import ModelInputs, nominal
from quadjax.fitting.signals import first_order
from quadjax.vehicle.constants import constant_names, from_values
from quadjax.vehicle.motor import MotorConstants

BAND = (1.0, 16.0)  # Hz
LAG = 0.05  # s, typical of rotors that follow their commands
TYPICAL = (2500.0, 35_000.0)  # rpm, of a racing drone's motors at commands 0 and 1
# Signs (3, 4) of roll, pitch and yaw of motors 1 to 4, by the nominal model.
ONE: MotorConstants = from_values(
    MotorConstants, dict.fromkeys(constant_names(MotorConstants), 1.0)
)
MIXER = nominal(ONE, ModelInputs(np.eye(4), *(np.zeros((4, k)) for k in (4, 3, 3))))[:, 3:].T


def typical_speeds(command: np.ndarray, sample_rate: float) -> np.ndarray:
    """Speeds (n, 4), rpm, of typical motors under commands (n, 4) from 0 to 1, sampled at Hz.

    They have the order, the direction and about the delay of the true ones, but not their scale.
    """
    steady = TYPICAL[0] + (TYPICAL[1] - TYPICAL[0]) * np.sqrt(np.clip(command, 0.0, 1.0))
    return first_order(steady, steady[0], LAG, 1.0 / sample_rate)


@dataclass(frozen=True)
class Moments:
    """Second moments of the angular accelerations and of the rotors' effects on them."""

    effects: np.ndarray  # (12, 12) of squared speeds, speeds and their derivatives
    product: np.ndarray  # (12, 3) of effects and angular accelerations
    turning: np.ndarray  # (3, 3) of angular accelerations
    count: float  # of independent samples

    def likelihood(self, orders: np.ndarray, spins: np.ndarray, gyro: np.ndarray) -> np.ndarray:
        """Log-likelihoods (h, 3) of roll, pitch and yaw, relative to rotors without effect.

        Args:
            orders: (h, 4) column of each motor.
            spins: (h,) -1 for propellers that turn the other way.
            gyro: (h, 3, 3), by which the rates are changed.
        """
        yaw = np.stack([np.ones_like(spins), np.ones_like(spins), spins], axis=1)
        mixer = (yaw[:, :, None] * MIXER) @ np.eye(4)[orders]
        total = np.zeros((len(orders), 3))
        for axis, blocks in enumerate(((0,), (0,), (1, 2))):
            weights = np.zeros((len(orders), len(blocks), 12))
            for row, block in enumerate(blocks):
                weights[:, row, 4 * block : 4 * block + 4] = mixer[:, axis]
            gram = weights @ self.effects @ weights.swapaxes(1, 2)
            product = (weights @ self.product @ gyro[:, axis, :, None])[..., 0]
            energy = ((gyro[:, axis] @ self.turning) * gyro[:, axis]).sum(axis=1)
            explained = _explained(gram, product) / np.maximum(energy, 1e-12)
            total[:, axis] = -0.5 * self.count * np.log1p(-np.clip(explained, 0.0, 1.0 - 1e-9))
        return total


def _explained(gram: np.ndarray, product: np.ndarray) -> np.ndarray:
    """Energy (h,) that one or two effects explain with non-negative factors."""
    positive = np.maximum(product, 0.0)
    diagonal = np.maximum(np.diagonal(gram, axis1=1, axis2=2), 1e-12)
    best = (positive**2 / diagonal).max(axis=1)
    if product.shape[1] == 1:
        return best
    determinant = np.maximum(diagonal.prod(axis=1) - gram[:, 0, 1] ** 2, 1e-12)
    first = (diagonal[:, 1] * product[:, 0] - gram[:, 0, 1] * product[:, 1]) / determinant
    second = (diagonal[:, 0] * product[:, 1] - gram[:, 0, 1] * product[:, 0]) / determinant
    both = first * product[:, 0] + second * product[:, 1]
    return np.where((first > 0.0) & (second > 0.0), np.maximum(both, best), best)


@dataclass(frozen=True)
class MotorEvidence:
    """What relates the motors of a log to its rates and commands: band-passed samples."""

    effects: np.ndarray  # (m, 12) squared speeds, speeds and their derivatives
    turning: np.ndarray  # (i, 3) angular accelerations of the inner samples, less the others
    others: np.ndarray  # (i, 9) orthonormal: what velocity and rates explain
    speeds: np.ndarray  # (m, 4) less their mean, and so are those that the commands cause:
    followed: np.ndarray | None  # (m, 4)
    inner: np.ndarray  # (i,) indices
    rate: float  # Hz
    counts: tuple[float, float]  # of independent samples: of the moments, of the commands

    def gains_of_gyro(self, changes: Sequence[Change]) -> np.ndarray:
        """Gains (h,) of log-likelihood by changes of the gyro."""
        total = self._moments([Change("gyro", ()), *changes], -1.0)
        return total[1:] - total[0]

    def gains_of_speeds(self, changes: Sequence[Change]) -> np.ndarray:
        """Gains (h,) of log-likelihood by changes of the rotors' speeds."""
        rows = [Change("rpm", ()), *changes]
        orders = np.array([change.order for change in rows])
        following = np.take_along_axis(self._following(rows, 1.0), orders[:, None], 1)
        total = self._moments(rows, 1.0) + following.sum(axis=(1, 2))
        return total[1:] - total[0]

    def gains_of_commands(self, changes: Sequence[Change]) -> np.ndarray:
        """Gains (h,) of log-likelihood by changes of the motors' commands."""
        rows = [Change("command", ()), *changes]
        orders = np.array([change.order for change in rows])
        following = np.take_along_axis(self._following(rows, -1.0), orders[:, :, None], 2)
        total = following.sum(axis=(1, 2))
        return total[1:] - total[0]

    def _late(self, delay: float) -> np.ndarray:
        """Indices (i,) of the inner samples of a signal that is late by ``delay`` s."""
        return np.clip(self.inner + round(delay * self.rate), 0, len(self.effects) - 1)

    def _moments(self, changes: Sequence[Change], sign: float) -> np.ndarray:
        """Log-likelihoods (h,) of the angular accelerations; ``sign`` -1: others are late."""
        orders = np.array([change.order for change in changes])
        spins = np.array([change.spin for change in changes])
        gyro = np.stack([change.matrix for change in changes])
        total = self._moments_at(0.0).likelihood(orders, spins, gyro)
        for i, change in enumerate(changes):
            if change.delay:
                axes = list(change.columns[:3])  # of the gyro, or all three for the motors
                late, row = self._moments_at(sign * change.delay), slice(i, i + 1)
                likelihood = late.likelihood(orders[row], spins[row], gyro[row])[0]
                total[i, axes] = likelihood[axes]
        return total.sum(axis=1)

    def _moments_at(self, delay: float) -> Moments:
        effects = self.effects[self._late(delay)]
        effects = effects - self.others @ (self.others.T @ effects)
        turning = self.turning
        return Moments(
            effects.T @ effects, effects.T @ turning, turning.T @ turning, self.counts[0]
        )

    def _following(self, changes: Sequence[Change], sign: float) -> np.ndarray:
        """Log-likelihoods (h, 4, 4) that a speed (row) follows a command (column)."""
        if self.followed is None:
            return np.zeros((len(changes), 4, 4))
        causes = self.followed[self.inner] - self.followed[self.inner].mean(axis=0)
        causes /= np.maximum(np.linalg.norm(causes, axis=0), 1e-12)
        correlations: dict[float, np.ndarray] = {}
        for delay in {change.delay for change in changes}:
            speeds = self.speeds[self._late(sign * delay)]
            speeds = speeds - speeds.mean(axis=0)
            speeds /= np.maximum(np.linalg.norm(speeds, axis=0), 1e-12)
            correlations[delay] = speeds.T @ causes
        correlation = np.stack([correlations[change.delay] for change in changes])
        explained = np.clip(correlation, 0.0, 1.0 - 1e-4) ** 2
        return -0.5 * self.counts[1] * np.log1p(-explained)


def motor_evidence(signals: Signals) -> MotorEvidence:
    """The evidence of a log's signals; of commands, where ``followed`` is among them."""
    rate = signals.rate
    band = (BAND[0], min(BAND[1], 0.4 * rate))
    sections = butter(2, band, "band", fs=rate, output="sos")

    def band_passed(values: np.ndarray) -> np.ndarray:
        return sosfiltfilt(sections, values, axis=0)

    rates, velocity, speeds = (signals.at(name) for name in ("gyro", "body_velocity", "rpm"))
    coupling = rates[:, [1, 2, 0]] * rates[:, [2, 0, 1]]
    others = band_passed(np.concatenate([velocity, rates, coupling], axis=1))
    basis = np.linalg.qr(others[signals.inner])[0]
    turning = derivative(band_passed(rates), rate)[signals.inner]
    relative = speeds / speeds.mean()
    passed = band_passed(relative)
    effects = (band_passed(relative**2), passed, derivative(passed, rate))

    def differences(name: str) -> np.ndarray:
        values = signals.at(name)
        return signals.low_pass(values - values.mean(axis=1, keepdims=True))

    return MotorEvidence(
        effects=np.concatenate(effects, axis=1),
        turning=turning - basis @ (basis.T @ turning),
        others=basis,
        speeds=differences("rpm"),
        followed=differences("followed") if "followed" in signals.values else None,
        inner=np.flatnonzero(signals.inner),
        rate=rate,
        counts=(signals.count(band[1] - band[0]), signals.count(MOTION)),
    )
