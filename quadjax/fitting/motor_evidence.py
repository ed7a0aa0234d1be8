"""Log-likelihoods of the order, spin and delay of a flight's motors.

The rotors' speeds cause the angular accelerations, by the nominal model with non-negative
constants, and follow their commands. Low frequencies are left out of the first, because there the
rotors' moments balance others that the model lacks.
"""

from collections.abc import Sequence

import numpy as np
from scipy.signal import butter, sosfiltfilt

from quadjax.fitting.identities import MOTION_BAND_HZ, Change, Signals, derivative
from quadjax.fitting.nominal import ModelInputs, nominal
from quadjax.fitting.signals import first_order
from quadjax.vehicle.constants import constant_names, from_values
from quadjax.vehicle.motor import MotorConstants

MOTOR_BAND_HZ = (1.0, 16.0)
TYPICAL_LAG_S = 0.05  # typical of rotors that follow their commands
TYPICAL_RPM = (2500.0, 35_000.0)  # of a racing drone's motors at commands 0 and 1
# Signs (3, 4) of roll, pitch and yaw of motors 1 to 4, by the nominal model.
ONE: MotorConstants = from_values(
    MotorConstants, dict.fromkeys(constant_names(MotorConstants), 1.0)
)
MIXER = nominal(ONE, ModelInputs(np.eye(4), *(np.zeros((4, k)) for k in (4, 3, 3))))[:, 3:].T


def typical_speeds(command: np.ndarray, sample_rate: float) -> np.ndarray:
    """Speeds (n, 4), rpm, of typical motors under commands (n, 4) from 0 to 1, sampled at Hz.

    They have the order, the direction and about the delay of the true ones, but not their scale.
    """
    steady = TYPICAL_RPM[0] + (TYPICAL_RPM[1] - TYPICAL_RPM[0]) * np.sqrt(
        np.clip(command, 0.0, 1.0)
    )
    return first_order(steady, steady[0], TYPICAL_LAG_S, 1.0 / sample_rate)


class MotorEvidence:
    """What relates the motors of a log to its rates and commands: band-passed samples."""

    def __init__(self, signals: Signals) -> None:
        """The evidence of a log's signals; of commands, where ``followed`` is among them."""
        rate = signals.rate
        band = (MOTOR_BAND_HZ[0], min(MOTOR_BAND_HZ[1], 0.4 * rate))
        sections = butter(2, band, "band", fs=rate, output="sos")

        def band_passed(values: np.ndarray) -> np.ndarray:
            return sosfiltfilt(sections, values, axis=0)

        def differences(name: str) -> np.ndarray:
            values = signals.at(name)
            return signals.low_pass(values - values.mean(axis=1, keepdims=True))

        rates, velocity, speeds = (signals.at(name) for name in ("gyro", "body_velocity", "rpm"))
        coupling = rates[:, [1, 2, 0]] * rates[:, [2, 0, 1]]
        others = band_passed(np.concatenate([velocity, rates, coupling], axis=1))
        turning = derivative(band_passed(rates), rate)[signals.inner]
        relative = speeds / speeds.mean()
        passed = band_passed(relative)
        effects = (band_passed(relative**2), passed, derivative(passed, rate))
        # (m, 12) squared speeds, speeds and their derivatives
        self.effects = np.concatenate(effects, axis=1)
        # (i, 9) orthonormal: what velocity and rates explain, of the inner samples
        self.others = np.linalg.qr(others[signals.inner])[0]
        # (i, 3) angular accelerations, less the others
        self.turning = turning - self.others @ (self.others.T @ turning)
        # (m, 4) less their mean, and so are those that the commands cause
        self.speeds = differences("rpm")
        self.followed = differences("followed") if "followed" in signals.values else None
        self.inner, self.rate = np.flatnonzero(signals.inner), rate
        # Independent samples: of the moments, of the commands.
        self.counts = (signals.count(band[1] - band[0]), signals.count(MOTION_BAND_HZ))

    def gains(self, quantity: str, changes: Sequence[Change]) -> np.ndarray:
        """Gains (h,) of log-likelihood by changes of "gyro", "rpm" or "followed", else 0."""
        rows = [Change(), *changes]
        sign = 1.0 if quantity == "rpm" else -1.0  # of the delay of the speeds
        total = np.zeros(len(rows))
        if quantity in ("gyro", "rpm"):
            total += self._moments(rows, sign)
        if quantity in ("rpm", "followed") and self.followed is not None:
            following = self._following(self.followed, rows, sign)
            following = following if quantity == "rpm" else following.swapaxes(1, 2)
            orders = np.array([change.order for change in rows])[:, None]
            total += np.take_along_axis(following, orders, 1).sum(axis=(1, 2))
        return total[1:] - total[0]

    def _late(self, values: np.ndarray, delay: float) -> np.ndarray:
        """The inner samples (i, k) of signals (m, k) that are late by ``delay`` s."""
        return values[np.clip(self.inner + round(delay * self.rate), 0, len(values) - 1)]

    def _moments(self, changes: Sequence[Change], sign: float) -> np.ndarray:
        """Log-likelihoods (h,) of the angular accelerations; ``sign`` -1: they are late."""
        total = self._moments_at(0.0, changes)
        delays = np.array([change.delay for change in changes])
        axes = np.array([[i in change.columns for i in range(3)] for change in changes])
        for delay in np.unique(delays[delays != 0.0]):
            rows = np.flatnonzero(delays == delay)
            late = self._moments_at(sign * delay, [changes[i] for i in rows.tolist()])
            total[rows] = np.where(axes[rows], late, total[rows])
        return total.sum(axis=1)

    def _moments_at(self, delay: float, changes: Sequence[Change]) -> np.ndarray:
        """Log-likelihoods (h, 3) of roll, pitch and yaw, relative to rotors without effect."""
        effects = self._late(self.effects, delay)
        effects = effects - self.others @ (self.others.T @ effects)
        gyro = np.stack([change.matrix for change in changes])
        energy = ((gyro @ (self.turning.T @ self.turning)) * gyro).sum(axis=2)
        mixer = MIXER @ np.eye(4)[[change.order for change in changes]]
        mixer[:, 2] *= np.array([[change.spin] for change in changes])
        explained = np.empty_like(energy)
        for axis, blocks in enumerate(((0,), (0,), (1, 2))):
            weights = np.zeros((len(changes), len(blocks), 12))
            for row, block in enumerate(blocks):
                weights[:, row, 4 * block : 4 * block + 4] = mixer[:, axis]
            gram = weights @ (effects.T @ effects) @ weights.swapaxes(1, 2)
            product = weights @ (effects.T @ self.turning) @ gyro[:, axis, :, None]
            explained[:, axis] = _explained(gram, product[..., 0])
        explained /= np.maximum(energy, 1e-12)
        return -0.5 * self.counts[0] * np.log1p(-np.clip(explained, 0.0, 1.0 - 1e-9))

    def _following(
        self, followed: np.ndarray, changes: Sequence[Change], sign: float
    ) -> np.ndarray:
        """Log-likelihoods (h, 4, 4) that a speed (row) follows a command (column)."""
        delays = [change.delay for change in changes]
        causes = _normal(self._late(followed, 0.0))
        correlations = {
            delay: _normal(self._late(self.speeds, sign * delay)).T @ causes
            for delay in set(delays)
        }
        correlation = np.stack([correlations[delay] for delay in delays])
        explained = np.clip(correlation, 0.0, 1.0 - 1e-4) ** 2
        return -0.5 * self.counts[1] * np.log1p(-explained)


def _normal(values: np.ndarray) -> np.ndarray:
    """Signals (i, k) less their means, of length 1."""
    values = values - values.mean(axis=0)
    return values / np.maximum(np.linalg.norm(values, axis=0), 1e-12)


def _explained(gram: np.ndarray, product: np.ndarray) -> np.ndarray:
    """Energy (h,) that one or two effects explain with non-negative factors."""
    diagonal = np.maximum(np.diagonal(gram, axis1=1, axis2=2), 1e-12)
    best = (np.maximum(product, 0.0) ** 2 / diagonal).max(axis=1)
    if product.shape[1] == 1:
        return best
    determinant = np.maximum(diagonal.prod(axis=1) - gram[:, 0, 1] ** 2, 1e-12)[:, None]
    factors = (diagonal[:, ::-1] * product - gram[:, :1, 1] * product[:, ::-1]) / determinant
    both = (factors * product).sum(axis=1)
    return np.where((factors > 0.0).all(axis=1), np.maximum(both, best), best)
