"""One row of a table: flights of one policy under one condition, and what is computed of them."""

import dataclasses
import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Optional

import jax
import numpy as np
from scipy.special import stdtrit  # scipy.stats takes a second to import

from quadjax.core.vectors import safe_norm
from quadjax.flights.flight import Flight
from quadjax.race.environment import Race
from quadjax.race.laps import OUT_OF_TIME, Laps, LapState
from quadjax.race.types import RaceParams

MAX_NAMED_RUNS = 8  # runs that ended alike, of which the numbers are named
CONFIDENCE = 0.95  # of an interval


class Speeds(NamedTuple):
    """Speeds of flights, (runs,) each."""

    first: np.ndarray  # s until the first gate, 0 without one
    highest: np.ndarray  # m/s
    above: np.ndarray  # s above a speed


@dataclasses.dataclass(frozen=True, eq=False)
class Row:
    """Flights of one policy under one condition."""

    policy: str  # label of the policy
    laps: Laps  # of all flights; those of one drone follow each other
    condition: str = ""  # label of the condition; "" for the race as it is
    drones: int = 1  # number of drones of a plant that share the flights
    speeds: Speeds | None = None  # of the flights, where they are recorded
    speed_limit: float | None = None  # m/s, that ``speeds.above`` counts from; None: unknown
    # returns the flights, of those on the plant one of each of the first drones
    record: Callable[[], list[Flight]] = dataclasses.field(default=list, repr=False)
    published: Optional["Row"] = None  # the published row of the same race and protocol
    best_known_lap: float | None = None  # s, in the race
    at_limit: float = math.nan  # share of the motor commands at a limit, on a plant

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
        still = [reason in ("", OUT_OF_TIME) for reason in self.laps.crashes]
        return int((still & (self.laps.laps_completed() == 0)).sum())

    @property
    def ends(self) -> dict[str, int]:
        """Number of flights that ended early, by reason."""
        return dict(sorted(Counter(reason for reason in self.laps.crashes if reason).items()))

    @property
    def lap_means(self) -> tuple[float, ...]:
        """Mean of each lap over the flights that finish, s; if none does, over those with it."""
        times = self.laps.lap_times[self.done] if self.finished else self.laps.lap_times
        laps = (lap[np.isfinite(lap)] for lap in times.T)
        return tuple(float(lap.mean()) if lap.size else math.nan for lap in laps)

    @property
    def numbers(self) -> dict[str, float]:
        """Further numbers by name; NaN where there is none.

        ``lap`` is the median of all laps but the first of every flight, s. The others are of the
        flights that finish: ``time``, ``mean`` and ``best``, median, mean and minimum of the time
        of all laps, s; ``median_lap``, the median of their median laps but the first, s;
        ``between``, the median time from the first to the last gate, s; ``highest_speed``, m/s;
        ``seconds_above``, the mean time above ``speed_limit``, s.
        """
        totals, later = self.laps.totals[self.done], self.laps.lap_times[:, 1:]
        of_flights = np.median(later[self.done], axis=1) if later.size else later
        values: dict[str, tuple[Callable[[np.ndarray], Any], np.ndarray]] = {
            "time": (np.median, totals),
            "mean": (np.mean, totals),
            "best": (np.min, totals),
            "lap": (np.median, later[np.isfinite(later)]),
            "median_lap": (np.median, of_flights),
        }
        if self.speeds is not None:
            first, highest, above = (speed[self.done] for speed in self.speeds)
            values |= {"between": (np.median, totals - first), "highest_speed": (np.max, highest)}
            values["seconds_above"] = (np.mean, above if self.speed_limit else above[:0])
        return {
            name: float(reduce(numbers)) if numbers.size else math.nan
            for name, (reduce, numbers) in values.items()
        }

    @property
    def total(self) -> float:
        """Mean time of all laps over the flights that finish, s; NaN if none does."""
        return self.numbers["mean"]

    @property
    def drone_laps(self) -> np.ndarray:
        """Mean laps (drones, laps) of the flights that finish of each drone, s; NaN without one."""
        laps = self.laps.lap_times.reshape(self.drones, -1, self.laps.lap_times.shape[1])
        finished = (flights[np.isfinite(flights.sum(axis=1))] for flights in laps)
        none = np.full(laps.shape[2], np.nan)
        return np.stack([x.mean(axis=0) if len(x) else none for x in finished])

    @property
    def drone_totals(self) -> np.ndarray:
        """Mean total (drones,) of the flights that finish of each drone, s; NaN without one."""
        return self.drone_laps.sum(axis=1)

    def to_json(self) -> dict[str, Any]:
        """Numbers of the row as JSON takes them; null where there is none."""
        counts = ("runs", "finished", "crashed", "without_lap", "drones")
        numbers = self.numbers.items()
        return (
            {"policy": self.policy, "label": self.condition}
            | {name: getattr(self, name) for name in counts}
            | {name: round(x, 4) if math.isfinite(x) else None for name, x in numbers}
            | {"crashes": self.ends}
        )


def speed_record(
    _environment: Race, _params: RaceParams, race: LapState, _action: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Of each drone (runs,), for ``fly_race``: speed, m/s, target gate, and whether it is over."""
    return safe_norm(race.state.drone.velocity), race.state.target, race.over


def speeds_of(
    record: tuple[jax.Array, jax.Array, jax.Array], laps: Laps, time_step: float, limit: float
) -> Speeds:
    """Speeds of flights.

    Args:
        record: of ``speed_record``, (steps, runs) each, before each step.
        laps: of the flights.
        time_step: s.
        limit: m/s, that the time above is counted from.
    """
    speed, target, over = map(np.asarray, record)
    speed, going = speed[1:].astype(np.float64), ~over[:-1]  # after each step
    first = time_step * (target != target[0]).argmax(axis=0)
    if not first.any():  # a track of one gate
        first = np.nan_to_num(laps.lap_times[:, 0])
    above = time_step * (going & (speed > limit)).sum(axis=0)
    return Speeds(first, speed.max(axis=0), above)


def concatenate(laps: Sequence[Laps]) -> Laps:
    """Flights of several simulations of the same race."""
    return dataclasses.replace(
        laps[0],
        lap_times=np.concatenate([part.lap_times for part in laps]),
        crashes=tuple(reason for part in laps for reason in part.crashes),
        seconds=np.concatenate([part.seconds for part in laps]),
    )


def describe_crashes(laps: Laps) -> list[str]:
    """One line for each reason and lap in which runs ended early.

    Up to ``MAX_NAMED_RUNS`` runs are listed by their numbers, from 1.
    """
    completed = laps.laps_completed()
    ways: dict[str, list[int]] = {}
    for run, reason in enumerate(laps.crashes):
        if reason:
            ways.setdefault(f"{reason} in lap {completed[run] + 1}", []).append(run)
    lines = []
    for how, runs in ways.items():
        who = f"{len(runs)} runs"
        if len(runs) <= MAX_NAMED_RUNS:
            who = f"run{'s' * (len(runs) > 1)} {', '.join(str(run + 1) for run in runs)}"
        first, last = (f"{end(laps.seconds[runs]):.2f}" for end in (np.min, np.max))
        lines.append(f"{who}: {how} after {first}{f' to {last}' * (last != first)} s")
    return lines


def interval(values: np.ndarray) -> tuple[float, float]:
    """Mean of the finite values (n,), and half the width of its 95% interval; NaN for fewer."""
    finite = values[np.isfinite(values)]
    if finite.size < 2:
        return float(finite[0]) if finite.size else math.nan, math.nan
    width = stdtrit(finite.size - 1, 0.5 + 0.5 * CONFIDENCE) * finite.std(ddof=1)
    return float(finite.mean()), float(width / np.sqrt(finite.size))
