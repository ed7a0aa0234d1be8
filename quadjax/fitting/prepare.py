"""Model inputs and targets from flight logs: filtering, derivatives, moments, trimming.

Every signal goes through the same zero-phase second-order Butterworth low-pass (Ferede et al.,
arXiv 2311.16948: 16 Hz). The regressors of the nominal model are formed from the measured signals
and then filtered like the targets, so that least squares stay exact for a model that is nonlinear
in the propeller speeds. The inputs of the residual networks are the filtered signals.

White noise left in a regressor biases its constant towards zero. Its level is estimated from the
part of the spectrum above the motion of a quadcopter; noise of that level is added to the signals
once more, and the change of the regressors (``Samples.noise``) corrects the least squares.
"""

from dataclasses import replace

import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.fitting.config import PrepareConfig
from quadjax.fitting.flight_log import FlightLog
from quadjax.fitting.nominal import AXES, Constants, ModelInputs, angular_moment, regressors
from quadjax.fitting.signals import Rows, concatenated, derivative, low_pass, noise_level


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


def airborne(log: FlightLog, config: PrepareConfig) -> np.ndarray:
    """Rows (n,) in flight: by the log's mode and the propeller speeds.

    Speeds below a fraction of the flight's median count as on the ground at both ends of the log,
    and elsewhere if they last; a dive is short.
    """
    mean = log.rpm.mean(axis=1)
    if not log.flying.any():
        raise InputError(f"{log.path}: the log's mode is never above 0: no flight")
    spinning = mean >= config.airborne_fraction * np.median(mean[log.flying])
    edges = np.flatnonzero(np.diff(np.concatenate([[True], spinning, [True]])))
    mask = log.flying.copy()
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        at_an_end = start == 0 or stop == len(mean)
        if at_an_end or stop - start > config.airborne_pause * log.sample_rate:
            mask[start:stop] = False
    return mask


def prepare(
    logs: list[FlightLog], constants: Constants, config: PrepareConfig, min_seconds: float
) -> Samples:
    """Inputs, regressors and targets of every flight's airborne part.

    Args:
        logs: flights of one drone, of any sample rates.
        constants: of the model; with the inertia, if it has one.
        config: of filtering and trimming.
        min_seconds: shortest allowed flight time of a log, s.

    Raises:
        InputError: a flight with too little airborne time, or a cut-off too high for its rate.
    """
    parts = [
        _prepare_one(log, index, constants, config, min_seconds) for index, log in enumerate(logs)
    ]
    return join(parts)


def join(parts: list[Samples]) -> Samples:
    """The rows of several parts, with their median sample rate."""
    rate = float(np.median([part.sample_rate for part in parts]))
    return concatenated([part.replace(sample_rate=rate) for part in parts])


def _prepare_one(
    log: FlightLog,
    index: int,
    constants: Constants,
    config: PrepareConfig,
    min_seconds: float,
) -> Samples:
    rows = airborne(log, config)
    if rows.sum() < min_seconds * log.sample_rate:
        raise InputError(
            f"{log.path}: {rows.sum() / log.sample_rate:.3g} s of flight, expected at least "
            f"{min_seconds:g} s (logs.min_seconds)"
        )
    rate = log.sample_rate

    def smooth(signal: np.ndarray) -> np.ndarray:
        return low_pass(signal, rate, config.cutoff)

    def filtered_regressors(motion: ModelInputs) -> dict[str, np.ndarray]:
        return {axis: smooth(columns) for axis, columns in regressors(motion, constants).items()}

    still = np.zeros_like(log.rates)
    rates, rpm = smooth(log.rates), smooth(log.rpm)
    moment = angular_moment(constants, still, derivative(rates, rate))
    moment += smooth(angular_moment(constants, log.rates, still))
    exact = filtered_regressors(_raw_motion(log))
    noisier = filtered_regressors(_raw_motion(_with_noise_again(log, config.cutoff, index)))
    samples = Samples(
        ModelInputs(rpm, derivative(rpm, rate), smooth(log.body_velocity), rates),
        exact,
        {axis: noisier[axis] - exact[axis] for axis in AXES},
        np.concatenate([smooth(log.specific_force), moment], axis=1),
        np.full(len(log.time), index),
        log.time - log.time[0],
        rate,
    )
    return samples[rows]


def _raw_motion(log: FlightLog) -> ModelInputs:
    return ModelInputs(log.rpm, derivative(log.rpm, log.sample_rate), log.body_velocity, log.rates)


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


def thin(samples: Samples, sample_rate: float) -> Samples:
    """Every k-th row, so that the sample rate is about ``sample_rate`` Hz."""
    return samples[:: max(1, int(round(samples.sample_rate / sample_rate)))]
