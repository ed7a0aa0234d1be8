"""Model inputs and targets from flight logs: filtering, derivatives, moments, trimming.

Every signal goes through the same zero-phase second-order Butterworth low-pass (Ferede et al.,
arXiv 2311.16948: 16 Hz). The regressors of the nominal model are formed from the measured signals
and then filtered like the targets, so that least squares stay exact for a model that is nonlinear
in the propeller speeds. The inputs of the residual networks are the filtered signals.

White noise left in a regressor biases its constant towards zero. Its level is estimated from the
part of the spectrum above the motion of a quadcopter; noise of that level is added to the signals
once more, and the change of the regressors (``Samples.noise``) corrects the least squares.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.nominal import Constants, ModelInputs, angular_moment, regressors
from quadjax.fitting.signals import Rows, concatenated, derivative, low_pass, noise_level

AIRBORNE = 0.5  # of the flight's median rpm, below which it is on the ground
PAUSE = 1.0  # s below it that count as a landing
SETTLING = 0.5  # s, until unknown propeller speeds of the start have no effect


@struct.dataclass
class Samples(Rows):
    """Rows of one or more flights."""

    motion: ModelInputs  # filtered inputs of the model
    regressors: dict[str, np.ndarray]  # axis: (n, k), filtered
    noise: dict[str, np.ndarray]  # axis: (n, k), change of the regressors by added noise
    measured: np.ndarray  # (n, 6) specific force, m/s^2, and moment, filtered; as AXES
    flight: np.ndarray  # (n,) index of the flight
    time: np.ndarray  # (n,) s, in the flight
    sample_rate: float = struct.field(pytree_node=False)  # Hz

    def __len__(self) -> int:
        return len(self.time)


def airborne(log: FlightLog) -> np.ndarray:
    """Rows (n,) bool in flight: by the log's mode and the propeller speeds.

    Speeds below a fraction of the flight's median count as on the ground at both ends of the log,
    and elsewhere if they last; a dive is short. Without measured speeds a flight begins when those
    at its start, which are not known, have no effect.
    """
    mean = log.rpm.mean(axis=1)
    if not log.flying.any():
        raise InputError(f"{log.path}: the log's mode is never above 0: no flight")
    spinning = mean >= AIRBORNE * np.median(mean[log.flying])
    edges = np.flatnonzero(np.diff(np.concatenate([[True], spinning, [True]])))
    mask = log.flying.copy()
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        at_an_end = start == 0 or stop == len(mean)
        if at_an_end or stop - start > PAUSE * log.sample_rate:
            mask[start:stop] = False
    return mask if log.speeds_measured else mask & (log.time - log.time[0] > SETTLING)


def flight_rows(logs: Sequence[FlightLog], min_seconds: float = 0.0) -> list[np.ndarray]:
    """The rows (n,) bool in flight of each log.

    Raises:
        InputError: a log with less than ``min_seconds`` of flight.
    """
    rows = [airborne(log) for log in logs]
    for log, flying in zip(logs, rows, strict=True):
        if flying.sum() < min_seconds * log.sample_rate:
            raise InputError(
                f"{log.path}: {flying.sum() / log.sample_rate:.3g} s of flight, expected at least "
                f"{min_seconds:g} s (logs.min_seconds)"
            )
    return rows


def prepare(
    logs: Sequence[FlightLog], constants: Constants, cutoff: float, rows: Sequence[np.ndarray]
) -> Samples:
    """Inputs, regressors and targets of some rows of flights.

    Args:
        logs: flights of one drone, of any sample rates.
        constants: of the model; with the inertia, if it has one.
        cutoff: of the low-pass, Hz.
        rows: of each flight, (n,) bool; see ``flight_rows``.

    Raises:
        InputError: a cut-off too high for the rate of a log.
    """
    return join(
        [
            _prepare_one(log, index, constants, cutoff)[used]
            for index, (log, used) in enumerate(zip(logs, rows, strict=True))
        ]
    )


def join(parts: list[Samples]) -> Samples:
    """The rows of several parts, with their median sample rate."""
    rate = float(np.median([part.sample_rate for part in parts]))
    return concatenated([part.replace(sample_rate=rate) for part in parts])


def thin(samples: Samples, sample_rate: float) -> Samples:
    """Every k-th row, so that the sample rate is about ``sample_rate`` Hz."""
    return samples[:: max(1, int(round(samples.sample_rate / sample_rate)))]


def _prepare_one(log: FlightLog, index: int, constants: Constants, cutoff: float) -> Samples:
    rate = log.sample_rate

    def smooth(signal: np.ndarray) -> np.ndarray:
        return low_pass(signal, rate, cutoff)

    def filtered_regressors(log: FlightLog) -> dict[str, np.ndarray]:
        motion = ModelInputs(log.rpm, derivative(log.rpm, rate), log.body_velocity, log.rates)
        return {axis: smooth(columns) for axis, columns in regressors(motion, constants).items()}

    still = np.zeros_like(log.rates)
    rates, rpm = smooth(log.rates), smooth(log.rpm)
    moment = angular_moment(constants, still, derivative(rates, rate))
    moment += smooth(angular_moment(constants, log.rates, still))
    exact, noisier = (
        filtered_regressors(each) for each in (log, _with_noise_again(log, cutoff, index))
    )
    return Samples(
        ModelInputs(rpm, derivative(rpm, rate), smooth(log.body_velocity), rates),
        exact,
        {axis: noisier[axis] - columns for axis, columns in exact.items()},
        np.concatenate([smooth(log.specific_force), moment], axis=1),
        np.full(len(log.time), index),
        log.time - log.time[0],
        rate,
    )


def _with_noise_again(log: FlightLog, cutoff: float, seed: int) -> FlightLog:
    random = np.random.default_rng(seed)

    def noisier(signal: np.ndarray) -> np.ndarray:
        level = noise_level(signal, log.sample_rate, cutoff)
        return signal + level * random.normal(size=signal.shape)

    return replace(
        log,
        rpm=noisier(log.rpm),
        body_velocity=noisier(log.body_velocity),
        rates=noisier(log.rates),
    )
