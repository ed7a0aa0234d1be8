"""The lap table: one line per policy, with a column per lap, the total, the best, the finishers."""

from collections.abc import Sequence

import numpy as np

from quadjax.race.laps import Laps
from quadjax.training.paper import Row

WIDTH = 80  # columns of a terminal


def lap_row(label: str, laps: Laps) -> Row:
    """The mean over the runs that completed every lap, and the best total among them.

    If no run finished, each lap is the mean over the runs that completed it.
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


def format_table(own: Sequence[Row], published: Sequence[Row] = ()) -> str:
    """The table as plain text, at most 80 columns wide: more laps continue in a second block.

    Args:
        own: lines of this project.
        published: lines to set below them.
    """
    rows = [*own, *published]
    labels = [row.label for row in rows]
    wide = max(map(len, labels))
    blocks: list[list[list[str]]] = [[]]
    for column in _columns(rows):
        used = wide + sum(len(other[0]) + 1 for other in blocks[-1])
        if blocks[-1] and used + len(column[0]) + 1 > WIDTH:
            blocks.append([])
        blocks[-1].append(column)
    text = []
    for block in blocks:
        lines = [
            " ".join([f"{label:<{wide}}", *(column[i] for column in block)])
            for i, label in enumerate(["", *labels])
        ]
        head, ours, theirs = lines[0], lines[1 : len(own) + 1], lines[len(own) + 1 :]
        text += [head, "-" * len(head), *ours]
        if theirs:
            text += ["published ".ljust(len(head), "-"), *theirs]
    return "\n".join([*text, "seconds; means over the runs that finished"])


def _columns(rows: Sequence[Row]) -> list[list[str]]:
    """Title and cells of every column, each padded to the column's width."""
    laps = max(len(row.laps) for row in rows)
    columns = []
    for lap in range(laps):
        cells = [_time(row.laps[lap] if lap < len(row.laps) else np.nan) for row in rows]
        columns.append([f"lap {lap + 1}", *cells])
    columns.append(["total", *(_time(row.total) for row in rows)])
    columns.append(["best", *(_time(row.best) for row in rows)])
    finished = ["-" if row.runs is None else f"{row.finished}/{row.runs}" for row in rows]
    columns.append(["finished", *finished])
    return [[f"{cell:>{max(map(len, column))}}" for cell in column] for column in columns]


def _time(seconds: float) -> str:
    return f"{seconds:.2f}" if np.isfinite(seconds) else "-"


def counted(number: int, noun: str) -> str:
    """A number with its noun: 1 lap, 2 laps."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def describe_crashes(laps: Laps) -> str:
    """One line for every way in which runs ended early, with their numbers from 1; or nothing."""
    completed = laps.laps_completed()
    ways: dict[str, list[str]] = {}
    for run, reason in enumerate(laps.crashes):
        if reason:
            how = f"{reason} in lap {completed[run] + 1} after {laps.seconds[run]:.2f} s"
            ways.setdefault(how, []).append(str(run + 1))
    return "\n".join(
        f"{'run' if len(runs) == 1 else 'runs'} {', '.join(runs)}: {how}"
        for how, runs in ways.items()
    )
