"""The lap table: one line per policy, a column per lap, the total, the best and who finished.

The published lines are those of Ferede et al. (arXiv 2311.16948): six laps from hover.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np

from quadjax.config.schema import Config
from quadjax.race.laps import Laps

PUBLISHED_LAPS = 6
PUBLISHED_DT = 0.01  # s
PUBLISHED_SIZE = (1.0, 1.0)  # m, of every gate
PUBLISHED_GATES = (  # x, y, z, m, and yaw, deg
    (2.0, -1.5, -1.5, 45.0),
    (2.0, 1.5, -1.5, 135.0),
    (-2.0, 1.5, -1.5, 225.0),
    (-2.0, -1.5, -1.5, 315.0),
)


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of the table; times in seconds, NaN where there is none."""

    label: str
    laps: tuple[float, ...]
    total: float
    best: float
    finished: int | None = None  # runs that flew every lap
    runs: int | None = None


PUBLISHED = (
    Row("E2E simulated", (2.97, 2.51, 2.56, 2.55, 2.59, 2.57), 15.75, np.nan),
    Row("INDI simulated", (3.20, 2.82, 2.75, 2.80, 2.81, 2.76), 17.14, np.nan),
    Row("E2E flown, mean of 5", (3.22, 2.79, 2.85, 2.82, 2.84, 2.83), 17.35, 17.09),
    Row("INDI flown, mean of 5", (3.28, 2.80, 2.82, 2.82, 2.84, 2.83), 17.40, 17.26),
)

# What the published policies need for six laps in a faithful simulator, s, by the vehicle they fly.
PUBLISHED_TOTALS = {
    "motor": ("published E2E policy", 15.70),
    "rate": ("published INDI policy", 17.04),
}


def lap_row(label: str, laps: Laps) -> Row:
    """The mean over the runs that flew every lap, and the best total among them.

    Where no run finished, each lap is the mean over the runs that flew it.
    """
    done = np.isfinite(laps.totals)
    times = laps.lap_times[done] if done.any() else laps.lap_times
    means = tuple(_mean(times[:, lap]) for lap in range(times.shape[1]))
    totals = laps.totals[done]
    best = float(totals.min()) if done.any() else np.nan
    return Row(label, means, _mean(totals), best, laps.finished, len(laps.crashes))


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else np.nan


def is_published_race(config: Config) -> bool:
    """Whether gates and time step are those of the published lap times."""
    gates = [(*gate.position, gate.yaw_deg, *gate.size) for gate in config.track.gates]
    published = [(*gate, *PUBLISHED_SIZE) for gate in PUBLISHED_GATES]
    same = len(gates) == len(published) and np.allclose(gates, published)
    return same and config.episode.dt == PUBLISHED_DT


def published_rows(config: Config, laps: int, from_hover: bool = True) -> tuple[Row, ...]:
    """The published lines, where they can be compared: same race, laps and start."""
    if from_hover and laps == PUBLISHED_LAPS and is_published_race(config):
        return PUBLISHED
    return ()


def published_total(config: Config) -> tuple[str, float] | None:
    """Label and time, s, of the published policy that a training run is measured against."""
    if config.evaluate.laps == PUBLISHED_LAPS and is_published_race(config):
        return PUBLISHED_TOTALS[config.vehicle.kind]
    return None


def format_table(own: Sequence[Row], published: Sequence[Row] = ()) -> str:
    """The table as plain text, at most 100 columns for six laps.

    Args:
        own: lines of this project.
        published: lines to set beside them.
    """
    rows = [*own, *published]
    laps = max(len(row.laps) for row in rows)
    label = max(len(row.label) for row in rows)
    titles = [*(f"lap {lap + 1}" for lap in range(laps)), "total", "best", "finished"]
    head = " ".join([" " * label, *(f"{title:>{_width(title)}}" for title in titles)])
    lines = [head, "-" * len(head), *(_line(row, label, titles, laps) for row in own)]
    if published:
        lines += [f"published {'-' * (len(head) - 10)}"]
        lines += [_line(row, label, titles, laps) for row in published]
    return "\n".join([*lines, "seconds; means over the runs that finished"])


def _width(title: str) -> int:
    return max(len(title), 6)


def _line(row: Row, label: int, titles: list[str], laps: int) -> str:
    times = [*row.laps, *[np.nan] * (laps - len(row.laps)), row.total, row.best]
    cells = [f"{time:.2f}" if np.isfinite(time) else "-" for time in times]
    cells.append("-" if row.runs is None else f"{row.finished}/{row.runs}")
    return " ".join(
        [
            f"{row.label:<{label}}",
            *(f"{c:>{_width(title)}}" for c, title in zip(cells, titles, strict=True)),
        ]
    )


def counted(number: int, noun: str) -> str:
    """A number with its noun: 1 lap, 2 laps."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def describe_crashes(laps: Laps) -> str:
    """One line for every way in which runs ended early, with their numbers from 1; or nothing."""
    flown, ways = laps.laps_flown(), {}
    for run, reason in enumerate(laps.crashes):
        if reason:
            how = f"{reason} in lap {flown[run] + 1} after {laps.seconds[run]:.2f} s"
            ways.setdefault(how, []).append(str(run + 1))
    return "\n".join(
        f"{'run' if len(runs) == 1 else 'runs'} {', '.join(runs)}: {how}"
        for how, runs in ways.items()
    )
