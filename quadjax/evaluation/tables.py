"""The lap table: one line per policy, with a column per lap, the total, the best, the finishers."""

import dataclasses
import textwrap
from collections.abc import Sequence

import numpy as np

from quadjax.race.laps import Laps

WIDTH = 80  # columns of a terminal
LISTED = 8  # runs of one kind
NARROW = 18  # columns of the labels, where all numbers fit next to them


@dataclasses.dataclass(frozen=True)
class Row:
    """One line of a lap table; times in seconds, NaN where there is none."""

    label: str
    laps: tuple[float, ...]
    total: float
    best: float
    finished: int | None = None  # runs that completed every lap
    runs: int | None = None
    last_gates: int = 0  # gates of the last lap where it is a part of one


def lap_row(label: str, laps: Laps) -> Row:
    """The mean over the runs that completed every lap, and the best total among them.

    If no run finished, each lap is the mean over the runs that completed it.
    """
    done = np.isfinite(laps.totals)
    times = laps.lap_times[done] if done.any() else laps.lap_times
    means = tuple(_mean(times[:, lap]) for lap in range(times.shape[1]))
    totals = laps.totals[done]
    best = float(totals.min()) if done.any() else np.nan
    return Row(label, means, _mean(totals), best, laps.finished, len(laps.crashes), laps.last_gates)


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else np.nan


def format_table(own: Sequence[Row], published: Sequence[Row] = ()) -> str:
    """The table as plain text, at most 80 columns wide.

    Long labels are wrapped; columns that do not fit continue in another block.

    Args:
        own: lines of this project.
        published: lines to set below them.
    """
    rows = [*own, *published]
    columns = _columns(rows)
    room = WIDTH - sum(len(column[0]) + 1 for column in columns)
    room = room if room >= NARROW else WIDTH // 2
    labels = [textwrap.wrap(row.label, room, subsequent_indent="  ") or [""] for row in rows]
    wide = max(len(line) for label in labels for line in label)
    text: list[str] = []
    while columns:
        count, used = 0, wide
        while count < len(columns) and used + len(columns[count][0]) < WIDTH:
            used += len(columns[count][0]) + 1
            count += 1
        block, columns = columns[:count], columns[count:]
        lines = [
            "\n".join([*label[:-1], " ".join([f"{label[-1]:<{wide}}", *(c[i] for c in block)])])
            for i, label in enumerate([[""], *labels])
        ]
        text += [lines[0], "-" * used, *lines[1 : len(own) + 1]]
        if published:
            text += ["published ".ljust(used, "-"), *lines[len(own) + 1 :]]
    return "\n".join([*text, "seconds; means over the runs that finished"])


def _columns(rows: Sequence[Row]) -> list[list[str]]:
    """Title and cells of every column, each padded to the column's width."""
    laps = max(len(row.laps) for row in rows)
    columns = []
    for lap in range(laps):
        cells = [_time(row.laps[lap] if lap < len(row.laps) else np.nan) for row in rows]
        part = next((row.last_gates for row in rows if row.last_gates and lap + 1 == laps), 0)
        columns.append([counted(part, "gate") if part else f"lap {lap + 1}", *cells])
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
        who = counted(len(runs), "run")
        if len(runs) <= LISTED:
            who = f"run{'s' * (len(runs) > 1)} {', '.join(str(run + 1) for run in runs)}"
        first, last = (f"{end(laps.seconds[runs]):.2f}" for end in (np.min, np.max))
        lines.append(f"{who}: {how} after {first}{f' to {last}' * (last != first)} s")
    return "\n".join(lines)
