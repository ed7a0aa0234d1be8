"""Tables of sampled signals, their filters and derivatives."""

from collections.abc import Sequence
from typing import Self, TypeVar

import jax
import numpy as np
from scipy.signal import butter, lfilter, sosfiltfilt, welch

from quadjax.core.errors import InputError


class Rows:
    """Base of dataclasses whose arrays, nested in any way, have the same rows (n, ..)."""

    def __getitem__(self, rows: slice | np.ndarray) -> Self:
        """Some of the rows."""
        return jax.tree.map(lambda values: values[rows], self)


Table = TypeVar("Table", bound=Rows)


def concatenated(parts: Sequence[Table]) -> Table:
    """The rows of several tables of the same fields."""
    return jax.tree.map(lambda *values: np.concatenate(values), *parts)


def low_pass(signal: np.ndarray, sample_rate: float, cutoff: float, axis: int = 0) -> np.ndarray:
    """Zero-phase second-order Butterworth low-pass.

    Args:
        signal: evenly spaced samples along ``axis``.
        sample_rate: Hz.
        cutoff: Hz; forwards and backwards, so -6 dB there.
        axis: of the samples.

    Raises:
        InputError: a cut-off that is not between zero and half the sample rate.
    """
    if not 0.0 < cutoff < 0.5 * sample_rate:
        raise InputError(
            f"a sample rate of {sample_rate:.4g} Hz is too low for a low-pass of {cutoff:g} Hz, "
            f"allowed: above {2.0 * cutoff:g} Hz"
        )
    return sosfiltfilt(butter(2, cutoff, fs=sample_rate, output="sos"), signal, axis=axis)


def derivative(signal: np.ndarray, sample_rate: float) -> np.ndarray:
    """Time derivative along the first axis, by fourth-order central differences."""
    slope = np.gradient(signal, 1.0 / sample_rate, axis=0)
    if len(signal) > 4:
        near, far = signal[3:-1] - signal[1:-3], signal[4:] - signal[:-4]
        slope[2:-2] = (8.0 * near - far) * (sample_rate / 12.0)
    return slope


def noise_level(signal: np.ndarray, sample_rate: float, cutoff: float) -> np.ndarray:
    """Standard deviation (k,) of the white noise in signals (n, k).

    From the median of the spectrum between 0.3 and 0.48 of the sample rate, above the drone's
    motion and robust against vibration peaks; zero where the cutoff is too close to that band.
    """
    if 0.3 * sample_rate < 2.0 * cutoff:
        return np.zeros(signal.shape[1])
    frequency, power = welch(signal, sample_rate, nperseg=min(256, len(signal)), axis=0)
    band = (frequency > 0.3 * sample_rate) & (frequency < 0.48 * sample_rate)
    return np.sqrt(np.median(power[band], axis=0) * 0.5 * sample_rate)


def first_order(command: np.ndarray, start: np.ndarray, tau: float, dt: float) -> np.ndarray:
    """Response (n, k) of a first-order lag, of tau s, to commands (n, k) held for dt s each.

    Commands (2, n, k) are those at the two times of Gauss's quadrature of each sample. ``start``
    (k,) is the response at the first sample.
    """
    kept = np.exp(-dt / tau)
    if command.ndim > 2:
        share = kept ** np.sqrt(1.0 / 3.0)  # of the earlier time over the later one
        command = (share * command[0] + command[1]) / (1.0 + share)
    start = np.asarray(start, np.float64)[None]
    tail, _ = lfilter([1.0 - kept], [1.0, -kept], command[:-1], axis=0, zi=kept * start)
    return np.concatenate([start, tail])
