"""The lap times of flights, with their score and their JSON form."""

import dataclasses
import math

import numpy as np


@dataclasses.dataclass(frozen=True)
class Laps:
    """The result of timed laps, as NumPy arrays."""

    lap_times: np.ndarray  # (runs, laps) s; NaN where not completed
    crashes: tuple[str, ...]  # why each run ended early; "" where it did not
    seconds: np.ndarray  # (runs,) s from the start to the end of the run
    time_limit: float  # s; no run lasts longer
    last_gates: int = 0  # gates of the last lap where it is a part of one; 0: it is whole
    reward: float | None = None  # mean of the runs' rewards, where these are the score

    @property
    def totals(self) -> np.ndarray:
        """Time of all laps (runs,), s; NaN where not finished."""
        return self.lap_times.sum(axis=1)

    @property
    def finished(self) -> int:
        """Number of runs that completed all laps."""
        return int(np.isfinite(self.totals).sum())

    @property
    def score(self) -> float:
        """Mean time of all laps, s, or minus the mean reward of the runs; lower is better.

        A run that does not finish counts as the time limit, which no run that finishes exceeds, so
        that a crash never improves the score. Infinite where no run finishes.
        """
        if self.reward is not None:
            return -self.reward
        if self.finished == 0:
            return math.inf
        return float(np.nan_to_num(self.totals, nan=self.time_limit).mean())

    @property
    def penalized(self) -> float:
        """Time of all laps, averaged over the runs, s; a missing lap counts as time_limit / laps.

        Finite where no run finishes, and lower for runs that crash later.
        """
        penalty = self.time_limit / self.lap_times.shape[1]
        return float(np.nan_to_num(self.lap_times, nan=penalty).sum(axis=1).mean())

    @property
    def whole_laps(self) -> np.ndarray:
        """Lap times (runs, laps), s, without a last lap of fewer gates."""
        return self.lap_times[:, :-1] if self.last_gates else self.lap_times

    def gap(self, best_known: float) -> float:
        """The fraction by which the fastest whole lap is slower than one of ``best_known`` s.

        Infinite where no whole lap was completed.
        """
        return float(np.nanmin(self.whole_laps, initial=np.inf)) / best_known - 1.0

    def laps_completed(self) -> np.ndarray:
        """Number of laps that each run completed, (runs,)."""
        return np.isfinite(self.lap_times).sum(axis=1)

    def ordered(self, runs: np.ndarray) -> "Laps":
        """The runs of these numbers (n,), in this order."""
        return dataclasses.replace(
            self,
            lap_times=self.lap_times[runs],
            crashes=tuple(self.crashes[run] for run in runs),
            seconds=self.seconds[runs],
        )

    def to_json(self) -> dict[str, object]:
        """The result as JSON takes it: ``null`` for laps that were not completed.

        Of the runs that ended early, ``crashes`` says which (from 0), in which lap (from 1), after
        how many seconds and why.
        """

        def number(x: float) -> float | None:
            return round(float(x), 4) if np.isfinite(x) else None

        ends = zip(self.laps_completed().tolist(), self.seconds, self.crashes, strict=True)
        last_lap = {"last_lap_gates": self.last_gates} if self.last_gates else {}
        return last_lap | {
            "laps": [[number(x) for x in run] for run in self.lap_times],
            "totals": [number(x) for x in self.totals],
            "finished": self.finished,
            "runs": len(self.crashes),
            "crashes": [
                {"run": run, "lap": laps + 1, "seconds": number(seconds), "reason": reason}
                for run, (laps, seconds, reason) in enumerate(ends)
                if reason
            ],
        }
