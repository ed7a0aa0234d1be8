"""Scale, delay and angle of a flight log's columns against the same signals from other columns.

Two signals with noise bound the factor between them from both sides: the regression of each on the
other (Frisch, 1934). A factor is wrong only if both bounds are outside the allowed range. A delay
is that of the largest correlation. An angle is that of the rotation in the plane of two columns
which fits best.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.signal import correlate

from quadjax.fitting.config import LogsConfig

SEARCHED = 0.6  # s, longest delay that is looked for
BETTER = 0.25  # fraction of the unexplained variance that a delay or an angle must leave
RELATED = 0.9  # least correlation at a delay


class Delay(NamedTuple):
    """How much later than its signal a column is, s, and the unexplained variance there."""

    seconds: float
    unexplained: float


def correlations(
    measured: np.ndarray, shown: np.ndarray, sample_rate: float
) -> tuple[np.ndarray, np.ndarray]:
    """Delays (k,) of a signal, s, and its correlations (k,) with another one; (n,) samples each."""
    count = len(measured)
    most = min(round(SEARCHED * sample_rate), count // 2)
    product = correlate(measured, shown, "full", "fft")[count - 1 - most : count + most]
    shifts = np.arange(-most, most + 1)
    # Energy of the parts that overlap at each shift.
    energies = []
    for signal, sign in ((measured, 1), (shown, -1)):
        total = np.concatenate([[0.0], np.cumsum(signal**2)])
        first, last = np.maximum(sign * shifts, 0), count + np.minimum(sign * shifts, 0)
        energies.append(total[last] - total[first])
    return shifts / sample_rate, product / np.sqrt(np.maximum(energies[0] * energies[1], 1e-24))


def delay_of(measured: np.ndarray, shown: np.ndarray, sample_rate: float) -> Delay:
    """The delay of a signal (n,) with the largest correlation with another one (n,)."""
    delays, correlation = correlations(measured, shown, sample_rate)
    best = int(correlation.argmax())
    return Delay(float(delays[best]), 1.0 - max(float(correlation[best]), 0.0) ** 2)


def late(delay: Delay, unexplained: float, slack: float, config: LogsConfig) -> bool:
    """Whether a delay is evident and longer than allowed.

    Args:
        delay: of a column.
        unexplained: fraction of its variance without the delay.
        slack: s, that the column may be late or early for another reason.
        config: with the allowed delay.
    """
    long = abs(delay.seconds) > config.max_delay + slack
    related = delay.unexplained < 1.0 - RELATED**2
    return long and related and delay.unexplained < BETTER * unexplained


def wrong_factor(measured: np.ndarray, shown: np.ndarray, config: LogsConfig) -> float | None:
    """The factor between two signals (n,) about their means, if it is outside the allowed range."""
    product = float(measured @ shown)
    if product <= 0.0:
        return None
    bounds = (product / float(shown @ shown), float(measured @ measured) / product)
    most = 1.0 + config.max_scale_error
    if min(bounds) > most or max(bounds) < 1.0 / most:
        return float(np.sqrt(bounds[0] * bounds[1]))
    return None


def wrong_angle(
    measured: np.ndarray, shown: np.ndarray, config: LogsConfig
) -> tuple[int, int, float] | None:
    """Two columns that are rotated by more than allowed: their indices and the angle, deg.

    Args:
        measured: (n, 3) along three axes.
        shown: (n, 3) the same vectors.
        config: with the allowed angle.
    """
    product = measured.T @ shown
    for i, k in itertools.combinations(range(3), 2):
        parallel = product[i, i] + product[k, k]
        angle = float(np.arctan2(product[k, i] - product[i, k], parallel))
        if abs(angle) <= np.radians(config.max_angle):
            continue
        cosine, sine = np.cos(angle), np.sin(angle)
        turned = shown[:, [i, k]] @ np.array([[cosine, sine], [-sine, cosine]])
        pair = measured[:, [i, k]]
        left = ((pair - turned) ** 2).sum(axis=0)
        before = ((pair - shown[:, [i, k]]) ** 2).sum(axis=0)
        if (left < BETTER * before).all():
            return i, k, float(np.degrees(angle))
    return None
