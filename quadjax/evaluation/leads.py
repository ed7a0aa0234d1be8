"""By how much one of two contenders is faster: means with 95% intervals, in NumPy.

Flights of a contender are lap times (drones, trainings, flights, laps), s, with NaN in a flight
that does not finish. Flights of one index on one drone have the same battery and noise, whatever
policy flies. Both contenders have the same drones and flights; the number of trainings may differ.

The interval is of a hierarchical bootstrap, which draws drones, trainings of each contender and, on
each drone, flights with replacement. A training is drawn for all drones at once where the same
policy flies all of them, and for each drone where it has its own policies. Each level draws one
fewer than it has, so that the variance of its mean has no bias (Rao and Wu, 1988).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

ENDS = (2.5, 97.5)  # percentiles of an interval


class Interval(NamedTuple):
    """A mean and the ends of its 95% interval, s; NaN where there is none."""

    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        """The numbers with their signs; "-" without a mean."""
        ends = f" [{self.low:+.2f}, {self.high:+.2f}]" if np.isfinite(self.low) else ""
        return f"{self.mean:+.2f}{ends}" if np.isfinite(self.mean) else "-"


@dataclasses.dataclass(frozen=True)
class Leads:
    """By how much the first of two contenders is faster, s: means over the drones.

    Times are of the pairs of flights of one index that both finish; the score is of all flights.
    """

    total: Interval
    laps: tuple[Interval, ...]
    later: Interval  # mean of the laps after the first; NaN without one
    drones: tuple[Interval, ...]  # total on each drone
    score: Interval
    scores: tuple[float, float]  # of each, s: the mean of ``totals``
    pairs: int  # that both finish
    of: int  # all pairs
    over: str  # what the intervals are over


def leads(
    first: np.ndarray,
    second: np.ndarray,
    failed_after: float,
    resamples: int = 2000,
    seed: int = 0,
    own: bool = False,
) -> Leads:
    """The lead of the first contender over the second.

    Args:
        first: its flights, (drones, trainings, flights, laps) s.
        second: flights of the other.
        failed_after: the total of a flight that does not finish, s, in the score.
        resamples: number of draws of the bootstrap.
        seed: of the bootstrap.
        own: whether the policies of each drone are its own.
    """
    values = _differences(first, second, failed_after)
    drones, one, two, flights, _ = values.shape
    draw = functools.partial(_weights, np.random.default_rng(seed), resamples)
    weights, shared = draw(drones), (draw(one), draw(two))
    sums = np.stack([_sums(x, draw, (draw(one), draw(two)) if own else shared) for x in values])
    with np.errstate(invalid="ignore"):
        laps = sums[..., :-2] / sums[..., -2:-1]
        later = laps[..., 1:].sum(axis=-1) / np.float64(laps.shape[-1] - 1)
        times = np.stack([laps.sum(axis=-1), later, sums[..., -1], *np.moveaxis(laps, -1, 0)])
        known = weights.T * np.isfinite(times)  # (columns, drones, draws)
        means = (known * np.nan_to_num(times)).sum(axis=1) / known.sum(axis=1)
    each = tuple(_interval(x, max(one, two, flights) > 1) for x in times[0])
    total, later, score, *by_lap = (_interval(x, max(values.shape[:-1]) > 1) for x in means)
    levels = {f"{drones} drones": drones, f"{one} and {two} trainings": max(one, two)}
    several = [name for name, count in (levels | {"flights": flights}).items() if count > 1]
    over = ", ".join(several) or "nothing"
    over += "; one training each" if one == two == 1 else ""
    scores = float(totals(first, failed_after).mean()), float(totals(second, failed_after).mean())
    pairs = int(values[..., -2].sum()), values[..., -2].size
    return Leads(total, tuple(by_lap), later, each, score, scores, *pairs, over)


def totals(flights: np.ndarray, failed_after: float) -> np.ndarray:
    """Total of each flight, s; that of one that does not finish is ``failed_after``."""
    times = flights.sum(axis=-1)
    return np.where(np.isfinite(times), times, failed_after)


def twice_the_mean(*contenders: np.ndarray) -> float:
    """Twice the mean total of all flights that finish, s, as if a failed one were flown again."""
    times = np.concatenate([flights.sum(axis=-1).ravel() for flights in contenders])
    done = times[np.isfinite(times)]
    return 2.0 * float(done.mean()) if done.size else float("nan")


def _differences(first: np.ndarray, second: np.ndarray, failed_after: float) -> np.ndarray:
    """Laps, whether both finish (laps are 0 if not), and score of each pair of flights.

    Shape (drones, trainings, trainings of the second, flights, laps + 2).
    """
    ahead = second[:, None] - first[:, :, None]
    both = np.isfinite(ahead).all(axis=-1, keepdims=True)
    one, two = (totals(flights, failed_after) for flights in (first, second))
    score = (two[:, None] - one[:, :, None])[..., None]
    return np.concatenate([np.where(both, ahead, 0.0), both, score], axis=-1)


def _sums(
    values: np.ndarray, draw: Callable[[int], np.ndarray], trainings: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Weighted sums (draws, k) of the values of one drone, (trainings, trainings, flights, k)."""
    flights = draw(values.shape[2])
    return np.einsum("abfk,rf,ra,rb->rk", values, flights, *trainings, optimize=True)


def _weights(random: np.random.Generator, resamples: int, count: int) -> np.ndarray:
    """Weight of each of ``count`` in each draw, (1 + resamples, count); the first are equal."""
    number, equal = max(count - 1, 1), np.full((1, count), 1.0 / count)
    return np.concatenate([equal, random.multinomial(number, equal[0], resamples) / number])


def _interval(draws: np.ndarray, several: bool) -> Interval:
    finite = draws[1:][np.isfinite(draws[1:])]
    low, high = np.percentile(finite, ENDS) if several and finite.size else (np.nan, np.nan)
    return Interval(float(draws[0]), float(low), float(high))
