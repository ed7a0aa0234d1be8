"""Cross-validation folds: whole flights, or parts of each flight's time.

The training rows are split into *folds*: groups of whole flights, or, by time, consecutive blocks.
A choice (early stopping, shrinkage, rejection) is validated on a fold that was not trained on. Test
rows are used for neither, only for ``residual.max_harm``.
"""

from dataclasses import dataclass

import numpy as np

from quadjax.core.errors import InputError
from quadjax.fitting.config import SplitConfig
from quadjax.fitting.prepare import Samples

TEST = -1
NOWHERE = -2  # unused rows next to test rows, within the filter's reach
GUARD = 0.1  # s


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


def make_split(samples: Samples, flights: list[str], config: SplitConfig) -> Split:
    """Assign rows to folds.

    Args:
        samples: rows of every flight.
        flights: their names.
        config: of the split.

    Raises:
        InputError: an unknown test flight, or too few flights.
    """
    by, groups = flight_groups(flights, config)
    fold = np.full(len(samples), TEST)
    if by == "time":
        names = tuple(f"block {index + 1}" for index in range(max(2, min(4, config.folds))))
        for flight in groups[0]:
            rows = np.flatnonzero(samples.flight == flight)
            fold[rows] = _blocks(samples.time[rows], len(names), config.test_fraction)
    else:
        names = tuple("+".join(flights[index] for index in group) for group in groups)
        for number, group in enumerate(groups):
            fold[np.isin(samples.flight, group)] = number
    return Split(by, fold, names)


def flight_groups(flights: list[str], config: SplitConfig) -> tuple[str, list[list[int]]]:
    """``flight`` or ``time``, and the indices of the training flights: of each fold, or all.

    Raises:
        InputError: an unknown test flight, or too few flights.
    """
    _check(flights, config)
    learned = [index for index, name in enumerate(flights) if name not in config.test_flights]
    if config.by == "time" or (config.by == "auto" and len(learned) < 2):
        return "time", [learned]
    if len(learned) < 2:
        raise InputError(
            f"split.by is 'flight' with {len(learned)} training flight, expected at least 2; "
            "add flights or set split.by=time"
        )
    count = min(config.folds, len(learned))
    return "flight", [learned[index::count] for index in range(count)]


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
