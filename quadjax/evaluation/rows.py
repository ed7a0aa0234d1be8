"""One row of a table: flights of one policy under one condition, and what is computed of them."""

import dataclasses
import math
from collections import Counter
from typing import Any, NamedTuple, Optional

import numpy as np
from scipy.stats import t as student

from quadjax.race.laps import OUT_OF_TIME, Laps

CONFIDENCE = 0.95  # of an interval
LISTED = 8  # runs of one kind whose numbers are named


class Speeds(NamedTuple):
    """Speeds of flights, (runs,) each."""

    first: np.ndarray  # s until the first gate, 0 without one
    highest: np.ndarray  # m/s
    above: np.ndarray  # s above a speed


@dataclasses.dataclass(frozen=True, eq=False)
class Row:
    """Flights of one policy under one condition.

    Attributes:
        policy: label of the policy.
        laps: of all flights; those of one drawn plant follow each other.
        condition: label of the condition; "" for the race as it is.
        plants: number of drawn plants that share the flights.
        speeds: of the flights, where they are recorded.
        speed_limit: m/s, that ``speeds.above`` counts from; None: unknown.
        published: whether the row is of published numbers, not of flights.
        beside: the published row of the same race and protocol.
    """

    policy: str
    laps: Laps
    condition: str = ""
    plants: int = 1
    speeds: Speeds | None = None
    speed_limit: float | None = None
    published: bool = False
    beside: Optional["Row"] = None

    @property
    def label(self) -> str:
        """Policy and condition."""
        return ", ".join(text for text in (self.policy, self.condition) if text)

    @property
    def runs(self) -> int:
        """Number of flights."""
        return len(self.laps.crashes)

    @property
    def finished(self) -> int:
        """Number of flights that completed every lap."""
        return self.laps.finished

    @property
    def done(self) -> np.ndarray:
        """Whether each flight finished, (runs,)."""
        return np.isfinite(self.laps.totals)

    @property
    def crashed(self) -> int:
        """Number of flights that ended early, but not because their time was over."""
        return sum(reason not in ("", OUT_OF_TIME) for reason in self.laps.crashes)

    @property
    def without_lap(self) -> int:
        """Number of flights that neither crash nor complete a lap."""
        none = self.laps.laps_completed() == 0
        return sum(map(bool, none & [reason in ("", OUT_OF_TIME) for reason in self.laps.crashes]))

    @property
    def lap_means(self) -> tuple[float, ...]:
        """Mean of each lap over the flights that finish, s; if none does, over those with it."""
        times = self.laps.lap_times[self.done] if self.finished else self.laps.lap_times
        return tuple(_mean(times[:, lap]) for lap in range(times.shape[1]))

    @property
    def total(self) -> float:
        """Mean time of all laps over the flights that finish, s; NaN if none does."""
        return _mean(self.laps.totals)

    @property
    def best(self) -> float:
        """Shortest time of all laps, s; NaN if no flight finishes."""
        return float(self.laps.totals[self.done].min()) if self.finished else math.nan

    @property
    def median_total(self) -> float:
        """Median time of all laps over the flights that finish, s."""
        return _median(self.laps.totals)

    @property
    def lap(self) -> float:
        """Median of all laps but the first of every flight, s."""
        return _median(self.laps.lap_times[:, 1:])

    @property
    def median_lap(self) -> float:
        """Median over the flights that finish of their median lap but the first, s."""
        laps = self.laps.lap_times[self.done, 1:]
        return _median(np.median(laps, axis=1)) if laps.size else math.nan

    @property
    def between(self) -> float:
        """Median time from the first to the last gate of the flights that finish, s."""
        return _median(self.laps.totals - self.speeds.first) if self.speeds else math.nan

    @property
    def highest_speed(self) -> float:
        """Highest speed of any flight that finishes, m/s."""
        if self.speeds is None or not self.finished:
            return math.nan
        return float(self.speeds.highest[self.done].max())

    @property
    def seconds_above(self) -> float:
        """Mean time above ``speed_limit`` of the flights that finish, s."""
        return _mean(self.speeds.above[self.done]) if self.speeds else math.nan

    @property
    def plant_laps(self) -> np.ndarray:
        """Mean laps (plants, laps) of the flights that finish on each plant, s; NaN without one."""
        laps = self.laps.lap_times.reshape(self.plants, -1, self.laps.lap_times.shape[1])
        done = np.isfinite(laps.sum(axis=2))
        return np.stack(
            [
                x[y].mean(axis=0) if y.any() else x[0] * np.nan
                for x, y in zip(laps, done, strict=True)
            ]
        )

    @property
    def plant_totals(self) -> np.ndarray:
        """Mean total (plants,) of the flights that finish on each plant, s; NaN without one."""
        return self.plant_laps.sum(axis=1)

    def to_json(self) -> dict[str, Any]:
        """Numbers of the row as JSON takes them; null where there is none."""
        numbers = {"time": self.median_total, "mean": self.total, "best": self.best}
        numbers |= {"lap": self.lap}
        if self.speeds is not None:
            numbers |= {"between": self.between, "highest_speed": self.highest_speed}
            limited = self.speed_limit is not None
            numbers |= {"seconds_above": self.seconds_above if limited else math.nan}
        counts = {"runs": self.runs, "finished": self.finished, "crashed": self.crashed}
        counts |= {"without_lap": self.without_lap, "plants": self.plants}
        return (
            {"policy": self.policy, "label": self.condition}
            | counts
            | {key: round(x, 4) if math.isfinite(x) else None for key, x in numbers.items()}
            | {"crashes": crash_counts(self.laps)}
        )


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else math.nan


def _median(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else math.nan


def interval(values: np.ndarray) -> tuple[float, float]:
    """Mean of the finite values (n,), and half the width of its 95% interval; NaN for fewer."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return math.nan, math.nan
    if finite.size == 1:
        return float(finite[0]), math.nan
    width = student.ppf(0.5 + 0.5 * CONFIDENCE, finite.size - 1) * finite.std(ddof=1)
    return float(finite.mean()), float(width / np.sqrt(finite.size))


def common(first: Row, second: Row) -> tuple[Row, Row]:
    """Two rows with the laps of the flights that both finish, NaN of the others.

    The flights of one index are of the same plant, battery and noise.
    """
    both = (first.done & second.done)[:, None]

    def masked(row: Row) -> Row:
        times = np.where(both, row.laps.lap_times, np.nan)
        return dataclasses.replace(row, laps=dataclasses.replace(row.laps, lap_times=times))

    return masked(first), masked(second)


def concatenate(laps: list[Laps]) -> Laps:
    """Flights of several simulations of the same race."""
    return dataclasses.replace(
        laps[0],
        lap_times=np.concatenate([each.lap_times for each in laps]),
        crashes=tuple(reason for each in laps for reason in each.crashes),
        seconds=np.concatenate([each.seconds for each in laps]),
    )


def crash_counts(laps: Laps) -> dict[str, int]:
    """Number of flights that ended early, by reason."""
    return dict(sorted(Counter(reason for reason in laps.crashes if reason).items()))


def describe_crashes(laps: Laps) -> str:
    """One line for each reason and lap in which runs ended early; empty if none did.

    Up to ``LISTED`` runs are given by their numbers, from 1.
    """
    completed = laps.laps_completed()
    ways: dict[str, list[int]] = {}
    for run, reason in enumerate(laps.crashes):
        if reason:
            ways.setdefault(f"{reason} in lap {completed[run] + 1}", []).append(run)
    lines = []
    for how, runs in ways.items():
        who = f"{len(runs)} runs"
        if len(runs) <= LISTED:
            who = f"run{'s' * (len(runs) > 1)} {', '.join(str(run + 1) for run in runs)}"
        first, last = (f"{end(laps.seconds[runs]):.2f}" for end in (np.min, np.max))
        lines.append(f"{who}: {how} after {first}{f' to {last}' * (last != first)} s")
    return "\n".join(lines)
