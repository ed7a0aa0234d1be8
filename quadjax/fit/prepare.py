"""From flight logs to model inputs and targets: filtering, derivatives, moments, trimming.

Every signal goes through the same zero-phase second-order Butterworth low-pass (Ferede et al.,
arXiv 2311.16948: 16 Hz). The nominal model's regressors are formed from the measured signals and
then filtered like the targets, so that the least squares stay exact for a model that is not linear
in the propeller speeds; the residual networks, which will see whatever the simulation gives them,
take the filtered signals themselves.
"""

from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, sosfiltfilt

from quadjax.errors import InputError
from quadjax.fit.config import PrepareConfig
from quadjax.fit.flight_log import FlightLog
from quadjax.fit.nominal import AXES, Motion, angular_moment, regressors
from quadjax.vehicle.constants import MotorConstants


@dataclass(frozen=True)
class Samples:
    """Rows of one or more flights, ready to fit."""

    motion: Motion  # filtered inputs of the model
    regressors: dict[str, np.ndarray]  # axis: (n, k), filtered
    measured: np.ndarray  # (n, 6) specific force, m/s^2, and moment, N m, filtered; as AXES
    flight: np.ndarray  # (n,) index of the flight
    time: np.ndarray  # (n,) s, in the flight
    sample_rate: float  # Hz

    def __getitem__(self, rows: slice | np.ndarray) -> "Samples":
        """Some of the rows."""
        return Samples(
            self.motion[rows],
            {axis: columns[rows] for axis, columns in self.regressors.items()},
            self.measured[rows],
            self.flight[rows],
            self.time[rows],
            self.sample_rate,
        )

    def __len__(self) -> int:
        return len(self.time)


def low_pass(signal: np.ndarray, sample_rate: float, cutoff: float) -> np.ndarray:
    """Zero-phase second-order Butterworth low-pass along the first axis.

    Args:
        signal: (n, ..) evenly spaced samples.
        sample_rate: Hz.
        cutoff: Hz; forwards and backwards, so -6 dB there.

    Raises:
        InputError: a cut-off that is not between zero and half the sample rate.
    """
    if not 0.0 < cutoff < 0.5 * sample_rate:
        raise InputError(
            f"prepare.cutoff is {cutoff} Hz, allowed: above 0 and below half the sample rate "
            f"({sample_rate:.4g} Hz)"
        )
    return sosfiltfilt(butter(2, cutoff, fs=sample_rate, output="sos"), signal, axis=0)


def airborne(log: FlightLog, config: PrepareConfig) -> np.ndarray:
    """Rows (n,) in flight: the log says so, and the propellers are not idling.

    Propellers below a fraction of the flight's median count as on the ground before take-off,
    after landing, and wherever that lasts; a dive is short.
    """
    mean = log.rpm.mean(axis=1)
    if not log.flying.any():
        raise InputError(f"{log.path}: the log's mode never says that the drone flies")
    spinning = mean >= config.airborne_fraction * np.median(mean[log.flying])
    edges = np.flatnonzero(np.diff(np.concatenate([[True], spinning, [True]])))
    mask = log.flying.copy()
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        at_an_end = start == 0 or stop == len(mean)
        if at_an_end or stop - start > config.airborne_pause * log.sample_rate:
            mask[start:stop] = False
    return mask


def prepare(
    logs: list[FlightLog], constants: MotorConstants, config: PrepareConfig, min_seconds: float
) -> Samples:
    """Inputs, regressors and targets of every flight's airborne part.

    Args:
        logs: flights, of the same drone; they may differ in sample rate.
        constants: for the inertia.
        config: the filter and what counts as flight.
        min_seconds: flight time that every log must have, s.

    Raises:
        InputError: a flight with too little airborne time, or a cut-off too high for its rate.
    """
    parts = [
        _prepare_one(log, index, constants, config, min_seconds) for index, log in enumerate(logs)
    ]
    return join(parts)


def join(parts: list[Samples]) -> Samples:
    """Rows of several parts after one another."""
    motions = [part.motion for part in parts]
    return Samples(
        Motion(
            *(
                np.concatenate([getattr(motion, name) for motion in motions])
                for name in ("rpm", "rpm_rate", "body_velocity", "rates")
            )
        ),
        {axis: np.concatenate([part.regressors[axis] for part in parts]) for axis in AXES},
        np.concatenate([part.measured for part in parts]),
        np.concatenate([part.flight for part in parts]),
        np.concatenate([part.time for part in parts]),
        float(np.median([part.sample_rate for part in parts])),
    )


def _prepare_one(
    log: FlightLog,
    index: int,
    constants: MotorConstants,
    config: PrepareConfig,
    min_seconds: float,
) -> Samples:
    rows = airborne(log, config)
    if rows.sum() < min_seconds * log.sample_rate:
        raise InputError(
            f"{log.path}: {rows.sum() / log.sample_rate:.3g} s in the air, expected at least "
            f"{min_seconds:g} s (logs.min_seconds)"
        )
    spacing = 1.0 / log.sample_rate

    def smooth(signal: np.ndarray) -> np.ndarray:
        return low_pass(signal, log.sample_rate, config.cutoff)

    def derivative(signal: np.ndarray) -> np.ndarray:
        return np.gradient(smooth(signal), spacing, axis=0)

    still = np.zeros_like(log.rates)
    raw = Motion(log.rpm, np.gradient(log.rpm, spacing, axis=0), log.body_velocity, log.rates)
    gyroscopic = smooth(angular_moment(constants, log.rates, still))
    moment = angular_moment(constants, still, derivative(log.rates)) + gyroscopic
    samples = Samples(
        Motion(smooth(log.rpm), derivative(log.rpm), smooth(log.body_velocity), smooth(log.rates)),
        {axis: smooth(columns) for axis, columns in regressors(raw).items()},
        np.concatenate([smooth(log.specific_force), moment], axis=1),
        np.full(len(log.time), index),
        log.time - log.time[0],
        log.sample_rate,
    )
    return samples[rows]


def thin(samples: Samples, sample_rate: float) -> Samples:
    """Every k-th row, so that about ``sample_rate`` Hz are left of what the filter has smoothed."""
    return samples[:: max(1, int(round(samples.sample_rate / sample_rate)))]
