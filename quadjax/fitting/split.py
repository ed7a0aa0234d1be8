"""Held-out data: whole flights, or parts of each flight's time.

The training rows are split into *folds*: groups of whole flights, or, by time, consecutive blocks.
Every choice (constants, early stopping, shrinkage, rejection) is validated on a fold that was not
trained on. Test rows are used for no choice; they are only predicted.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.config import SplitConfig

LeftOut = frozenset[int]  # folds that a fit does not use
ALL: LeftOut = frozenset()  # the fit that is written
TEST = -1
NOWHERE = -2  # unused rows next to test rows, within the filter's reach
GUARD = 0.1  # s
BLOCKS = 4  # of a flight's time, at most


@dataclass(frozen=True)
class Split:
    """A fold number for every row."""

    by: str  # flight, time
    fold: np.ndarray  # (n,) 0 .. folds - 1, TEST or NOWHERE
    names: tuple[str, ...]  # of the folds

    @property
    def folds(self) -> int:
        """Number of folds."""
        return len(self.names)

    def learned(self, left_out: LeftOut) -> np.ndarray:
        """Rows (n,) bool of all folds but some, without test rows."""
        return (self.fold >= 0) & ~np.isin(self.fold, list(left_out))

    def complete(self, leave_one_out: bool) -> list[LeftOut]:
        """Folds left out of each complete fit: none, and each flight, if wanted."""
        nested = leave_one_out and self.by == "flight" and self.folds > 1
        return [ALL] + [frozenset({fold}) for fold in range(self.folds) if nested]

    def held_out(
        self, flight: np.ndarray, flights: list[str], leave_one_out: bool
    ) -> Iterator[tuple[str, np.ndarray, LeftOut]]:
        """Name, rows (n,) bool, and the complete fit without them, of each held-out part."""
        for left_out in self.complete(leave_one_out)[1:]:
            (number,) = left_out
            yield self.names[number], self.fold == number, left_out
        for index, name in enumerate(flights):
            rows = (self.fold == TEST) & (flight == index)
            if rows.any():
                yield (name if self.by == "flight" else f"{name}, last part"), rows, ALL


def make_split(
    flight: np.ndarray, time: np.ndarray, flights: list[str], config: SplitConfig
) -> Split:
    """Assign rows to folds.

    Args:
        flight: (n,) index of the flight of each row.
        time: (n,) s, in the flight.
        flights: their names.
        config: of the split.

    Raises:
        InputError: an unknown test flight, or too few flights.
    """
    _check(flights, config)
    learned = [index for index, name in enumerate(flights) if name not in config.test_flights]
    fold = np.full(len(time), TEST)
    if config.by == "time" or (config.by == "auto" and len(learned) < 2):
        names = tuple(f"block {index + 1}" for index in range(min(BLOCKS, config.folds)))
        for index in learned:
            rows = np.flatnonzero(flight == index)
            fold[rows] = _blocks(time[rows], len(names), config.test_fraction)
        return Split("time", fold, names)
    if len(learned) < 2:
        raise InputError(
            f"split.by is 'flight' with {len(learned)} training flight, expected at least 2; "
            "add flights or set split.by=time"
        )
    count = min(config.folds, len(learned))
    groups = [learned[index::count] for index in range(count)]
    for number, group in enumerate(groups):
        fold[np.isin(flight, group)] = number
    return Split("flight", fold, tuple("+".join(flights[i] for i in group) for group in groups))


def _blocks(time: np.ndarray, count: int, test_fraction: float) -> np.ndarray:
    fraction = np.arange(len(time)) / len(time) / (1.0 - test_fraction)
    fold = np.minimum(np.floor(fraction * count).astype(int), count)
    last = time[fold < count][-1]
    fold[(fold < count) & (time > last - GUARD)] = NOWHERE
    fold[fold == count] = TEST
    return fold


def _check(flights: list[str], config: SplitConfig) -> None:
    for name in config.test_flights:
        if name not in flights:
            raise InputError(f"split.test_flights: no flight {name!r}; there are {flights}")
    if len(set(config.test_flights)) == len(flights):
        raise InputError("split.test_flights leaves no training flight")
