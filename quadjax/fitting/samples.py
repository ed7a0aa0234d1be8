"""Rows of flight logs as inputs and targets of a model, and the folds that they are held out in.

Every signal goes through the same zero-phase second-order Butterworth low-pass (Ferede et al.,
arXiv 2311.16948: 16 Hz). The regressors of the nominal model are formed from the measured signals
and then filtered like the targets, so that least squares stay exact for a model that is nonlinear
in the propeller speeds. The inputs of the residual networks are the filtered signals.

White noise left in a regressor biases its constant towards zero. Its level is estimated from the
part of the spectrum above the motion of a quadcopter; noise of that level is added to the signals
once more, and the change of the regressors (``Samples.noise``) corrects the least squares.

The training rows are split into *folds*: groups of whole flights, or, by time, consecutive blocks.
Every choice (constants, early stopping, shrinkage, rejection) is validated on a fold that was not
trained on. Test rows are used for no choice; they are only predicted.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from flax import struct

from quadjax.core.errors import InputError
from quadjax.fitting.config import SplitConfig
from quadjax.fitting.motor_evidence import typical_speeds
from quadjax.fitting.nominal import Constants, ModelInputs, angular_moment, regressors
from quadjax.fitting.quantities import GUARD_S, SETTLING_S
from quadjax.fitting.signals import Rows, concatenated, derivative, low_pass, noise_level
from quadjax.flights.flight import Flight

CUTOFF_HZ = 16.0
AIRBORNE = 0.5  # of the flight's median rpm, below which it is on the ground
PAUSE_S = 1.0  # below it that count as a landing

Folds = frozenset[int]  # the folds that a fit uses
TEST_ROW = -1
GUARD_ROW = -2  # unused rows next to test rows, within the filter's reach
BLOCKS = 4  # of a flight's time, at most


class Samples(struct.PyTreeNode, Rows):
    """Rows of one or more flights."""

    motion: ModelInputs  # filtered inputs of the model
    regressors: dict[str, np.ndarray]  # axis: (n, k), filtered
    noise: dict[str, np.ndarray]  # axis: (n, k), change of the regressors by added noise
    measured: np.ndarray  # (n, 6) specific force, m/s^2, and moment, filtered; as AXES
    flight: np.ndarray  # (n,) index of the flight
    time: np.ndarray  # (n,) s, in the flight
    sample_rate: float = struct.field(pytree_node=False)  # Hz


def settled(log: Flight) -> np.ndarray:
    """Samples (n,) bool in flight at which the unknown speeds of the start have no effect."""
    return log.flying & (log.time - log.time[0] > SETTLING_S)


def airborne(log: Flight, min_seconds: float = 0.0) -> np.ndarray:
    """Rows (n,) bool in flight: by the log's mode and the propeller speeds.

    Speeds below a fraction of the flight's median count as on the ground at both ends of the log,
    and elsewhere if they last; a dive is short. Without measured speeds a flight begins when those
    at its start, which are not known, have no effect.

    Raises:
        InputError: no flight, or less than ``min_seconds`` of it.
    """
    path, flying = log.source["path"], log.flying
    if not flying.any():
        raise InputError(f"{path}: the log's mode is never above 0: no flight")
    if "actuators" in log.signals:
        mask, speeds = flying.copy(), log["actuators"]
    else:
        mask, speeds = settled(log), typical_speeds(log["motor_command"], log.sample_rate)
    mean = speeds.mean(axis=1)
    spinning = mean >= AIRBORNE * np.median(mean[flying])
    edges = np.flatnonzero(np.diff(np.concatenate([[True], spinning, [True]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        at_an_end = start == 0 or stop == len(mean)
        if at_an_end or stop - start > PAUSE_S * log.sample_rate:
            mask[start:stop] = False
    if mask.sum() < min_seconds * log.sample_rate:
        whole = " without gaps" if log.source.get("gaps") else ""
        raise InputError(
            f"{path}: {mask.sum() / log.sample_rate:.3g} s of flight{whole}, expected at least "
            f"{min_seconds:g} s (logs.min_seconds)"
        )
    return mask


def prepare(logs: Sequence[Flight], constants: Constants, rows: Sequence[np.ndarray]) -> Samples:
    """Inputs, regressors and targets of some rows of flights.

    Args:
        logs: flights of one drone, of any sample rates; the result has their median.
        constants: of the model; with the inertia, if it has one.
        rows: of each flight, (n,) bool; see ``airborne``.

    Raises:
        InputError: a rate of a log that is too low for the low-pass.
    """
    parts = [
        _prepare_one(log, index, constants)[used]
        for index, (log, used) in enumerate(zip(logs, rows, strict=True))
    ]
    rate = float(np.median([part.sample_rate for part in parts]))
    return concatenated([part.replace(sample_rate=rate) for part in parts])


def filtered_regressors(log: Flight, constants: Constants) -> dict[str, np.ndarray]:
    """Regressors (n, k) of the measured signals by axis, filtered."""
    rate, rpm = log.sample_rate, log["actuators"]
    motion = ModelInputs(rpm, derivative(rpm, rate), log["body_velocity"], log["rates"])
    columns = regressors(motion, constants)
    return {axis: low_pass(values, rate, CUTOFF_HZ) for axis, values in columns.items()}


def _prepare_one(log: Flight, index: int, constants: Constants) -> Samples:
    rate, random = log.sample_rate, np.random.default_rng(index)

    def smooth(signal: np.ndarray) -> np.ndarray:
        return low_pass(signal, rate, CUTOFF_HZ)

    def noisier(signal: np.ndarray) -> np.ndarray:
        return signal + noise_level(signal, rate, CUTOFF_HZ) * random.normal(size=signal.shape)

    still = np.zeros_like(log["rates"])
    rates, rpm = smooth(log["rates"]), smooth(log["actuators"])
    moment = angular_moment(constants, still, derivative(rates, rate))
    moment += smooth(angular_moment(constants, log["rates"], still))
    exact = filtered_regressors(log, constants)
    again = {name: noisier(log[name]) for name in ("actuators", "body_velocity", "rates")}
    noisy = filtered_regressors(log.with_signals(**again), constants)
    return Samples(
        motion=ModelInputs(rpm, derivative(rpm, rate), smooth(log["body_velocity"]), rates),
        regressors=exact,
        noise={axis: noisy[axis] - columns for axis, columns in exact.items()},
        measured=np.concatenate([smooth(log["specific_force"]), moment], axis=1),
        flight=np.full(len(log.time), index),
        time=log.time - log.time[0],
        sample_rate=rate,
    )


@dataclass(frozen=True)
class Split:
    """A fold number for every row."""

    by: str  # flight, time
    fold: np.ndarray  # (n,) 0 .. folds - 1, TEST_ROW or GUARD_ROW
    names: tuple[str, ...]  # of the folds

    @property
    def all(self) -> Folds:
        """Every fold."""
        return frozenset(range(len(self.names)))

    def rows(self, folds: Folds) -> np.ndarray:
        """The rows (n,) bool of some folds."""
        return np.isin(self.fold, list(folds))

    def tests(self, flight: np.ndarray, flights: Sequence[str]) -> Iterator[tuple[str, np.ndarray]]:
        """Name and rows (n,) bool of the test rows of each flight that has some."""
        for index, name in enumerate(flights):
            rows = (self.fold == TEST_ROW) & (flight == index)
            if rows.any():
                yield (name if self.by == "flight" else f"{name}, last part"), rows


def make_split(times: Sequence[np.ndarray], flights: Sequence[str], config: SplitConfig) -> Split:
    """Assign rows to folds.

    Args:
        times: (n_i,) s of the rows of each flight.
        flights: their names.
        config: of the split.

    Raises:
        InputError: an unknown test flight, or too few flights.
    """
    for name in config.test_flights:
        if name not in flights:
            raise InputError(f"split.test_flights: no flight {name!r}; there are {list(flights)}")
    learned = [index for index, name in enumerate(flights) if name not in config.test_flights]
    if not learned:
        raise InputError("split.test_flights leaves no training flight")
    folds = [np.full(len(time), TEST_ROW) for time in times]
    if config.by == "time" or (config.by == "auto" and len(learned) < 2):
        count = min(BLOCKS, config.folds)
        for index in learned:
            folds[index] = _blocks(times[index], count, config.test_fraction)
        names = tuple(f"block {index + 1}" for index in range(count))
        return Split("time", np.concatenate(folds), names)
    if len(learned) < 2:
        raise InputError(
            f"split.by is 'flight' with {len(learned)} training flight, expected at least 2; "
            "add flights or set split.by=time"
        )
    count = min(config.folds, len(learned))
    for place, index in enumerate(learned):
        folds[index][:] = place % count
    groups = ("+".join(flights[i] for i in learned[number::count]) for number in range(count))
    return Split("flight", np.concatenate(folds), tuple(groups))


def _blocks(time: np.ndarray, count: int, test_fraction: float) -> np.ndarray:
    fraction = np.arange(len(time)) / len(time) / (1.0 - test_fraction)
    fold = np.minimum(np.floor(fraction * count).astype(int), count)
    last = time[fold < count][-1]
    fold[(fold < count) & (time > last - GUARD_S)] = GUARD_ROW
    fold[fold == count] = TEST_ROW
    return fold
