"""Training curves: the metrics of single runs, and lap times over several seeds."""

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.core.plotting import INK, MUTED, SERIES, head, new_figure, tidy
from quadjax.evaluation.published import published_total
from quadjax.evaluation.table import counted
from quadjax.training.result import read_metrics

Metrics = Mapping[str, np.ndarray]  # column name -> (rows,)
ACROSS = {"seconds": ("wall time (s)", 1.0), "steps": ("environment steps (millions)", 1e-6)}
UPWARDS = {"reward": "reward per step", "lap_total": "all laps (s)", "crash_rate": "crash rate"}
LAP_RANGE = 1.6  # the lap axis ends at this multiple of the best time
COLORS = (*SERIES, "#7b4fa3", "#5b6770", "#8c5a2b", "#c2569b")


def training_figure(
    runs: Mapping[str, Metrics], title: str = "", reference: tuple[str, float] | None = None
) -> Figure:
    """Reward, lap time and crash rate against wall time and environment steps.

    Draws those of the columns ``reward``, ``lap_total`` and ``crash_rate`` that the first run has,
    against ``seconds`` and ``steps``.

    Args:
        runs: metrics by the name of their run.
        title: of the figure.
        reference: a label and a time, s, to draw into the lap panels.

    Raises:
        InputError: none of the columns is there.
    """
    first = next(iter(runs.values()), {})
    across = [name for name in ACROSS if name in first]
    upwards = [name for name in UPWARDS if name in first and np.isfinite(first[name]).any()]
    if not across or not upwards:
        raise InputError(
            f"metrics have the columns {', '.join(first) or 'none'}; expected one of "
            f"{', '.join(ACROSS)} and one of {', '.join(UPWARDS)}"
        )
    figure = new_figure(4.6 * len(across) + 0.6, 2.1 * len(upwards) + 0.7)
    grid = figure.subplots(len(upwards), len(across), sharex="col", sharey="row", squeeze=False)
    for up, line in zip(upwards, grid, strict=True):
        for along, axes in zip(across, line, strict=True):
            tidy(axes)
            _draw_runs(axes, runs, along, up)
            if up == "lap_total":
                times = np.concatenate([columns[up] for columns in runs.values()])
                lap_axis(axes, times, [reference] if reference else [])
        line[0].set_ylabel(UPWARDS[up], color=INK)
    for along, axes in zip(across, grid[-1], strict=True):
        axes.set_xlabel(ACROSS[along][0], color=INK)
        axes.set_xlim(left=0.0)
    head(grid[0][0], title, columns=3)
    return figure


def _draw_runs(axes: Axes, runs: Mapping[str, Metrics], along: str, up: str) -> None:
    for index, (name, columns) in enumerate(runs.items()):
        if along not in columns or up not in columns:
            continue
        x, y = columns[along] * ACROSS[along][1], columns[up]
        fine = np.isfinite(x) & np.isfinite(y)
        color, label = SERIES[index % len(SERIES)], name if len(runs) > 1 else None
        mark = "o" if up == "lap_total" or np.count_nonzero(fine) == 1 else None
        axes.plot(x[fine], y[fine], color=color, lw=1.5, marker=mark, markersize=3, label=label)


def lap_axis(axes: Axes, times: np.ndarray, references: Sequence[tuple[str, float]]) -> None:
    """Limit the axis to times near the best one; the first laps are much slower.

    Args:
        axes: with times upwards, s.
        times: drawn on the axes, s; NaN and infinity are ignored.
        references: labels and times, s, to draw as horizontal lines.
    """
    for label, time in references:
        axes.axhline(time, color=MUTED, lw=1.0, ls="--", zorder=1)
        axes.annotate(
            label,
            xy=(1.0, time),
            xycoords=("axes fraction", "data"),
            xytext=(0, 3),
            textcoords="offset points",
            ha="right",
            fontsize=8,
            color=MUTED,
            annotation_clip=True,
        )
    shown = [*times[np.isfinite(times)], *(time for _, time in references)]
    if shown:
        axes.set_ylim(0.97 * min(shown), min(1.03 * max(shown), LAP_RANGE * min(shown)))
    if not np.isfinite(times).any():
        middle: dict[str, Any] = {"ha": "center", "va": "center", "transform": axes.transAxes}
        axes.text(0.5, 0.5, "no run completed its laps", color=MUTED, fontsize=10, **middle)
        axes.set_yticks([] if not shown else axes.get_yticks())


SCORES = {"mean": "mean action", "sampled": "sampled"}  # by run.score


@dataclasses.dataclass(frozen=True)
class Group:
    """Runs of one config over several seeds."""

    name: str
    runs: tuple[Mapping[str, np.ndarray], ...]  # columns of each run's metrics, (rows,) each
    length: str  # of a flight: 6 laps
    scores: str  # of the flights: sampled, of the mean action, or both
    published: tuple[str, float] | None  # label and time, s, of the published flights if equal


def learning_figure(groups: Mapping[str, Sequence[Path]], code: Collection[str] = ()) -> Figure:
    """Lap times of training runs (see ``run.score``) against wall time and environment steps.

    Each group has a color: a line for the median over its seeds, a band from the lowest to the
    highest. The time of a seed is that of its latest evaluation. A seed without a time (before its
    first evaluation, or if its policy does not complete every lap) counts as slower than any other,
    so the line exists where at least half of the seeds have a time. The band is of those that do.

    Args:
        groups: run folders, with ``config.yaml`` and ``metrics.csv``, by the name of their group.
        code: names ``module:OBJECT`` that may be imported from the runs' configs.

    Raises:
        InputError: a folder without them, runs of different numbers of laps, no group, or more
            groups than colors.
    """
    if not 0 < len(groups) <= len(COLORS):
        raise InputError(f"{len(groups)} groups of runs to draw, allowed: 1 to {len(COLORS)}")
    drawn = [read_group(name, folders, code) for name, folders in groups.items()]
    check_lengths({group.name: group.length for group in drawn})
    figure = new_figure(9.8, 4.2)
    panels = figure.subplots(1, len(ACROSS), sharey=True)
    published = [group.published for group in drawn if group.published]
    references = list(dict.fromkeys(published)) if len(published) == len(drawn) else []
    times = np.concatenate([run["lap_total"] for group in drawn for run in group.runs])
    for axes, (along, (label, unit)) in zip(panels, ACROSS.items(), strict=True):
        tidy(axes)
        for group, color in zip(drawn, COLORS, strict=False):
            _draw_group(axes, group, along, unit, color)
        lap_axis(axes, times, references)
        axes.set_xlabel(label, color=INK)
        axes.set_xlim(left=0.0)
    panels[0].set_ylabel(f"{drawn[0].length} (s)", color=INK)
    head(panels[0], "median over seeds; shaded from the fastest to the slowest")
    return figure


def check_lengths(lengths: Mapping[str, str]) -> None:
    """Raise an ``InputError`` if the lengths of races, by name, differ."""
    if len(set(lengths.values())) > 1:
        each = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"times of different numbers of laps cannot be compared: {each}")


def read_group(name: str, folders: Sequence[Path], code: Collection[str] = ()) -> Group:
    """Read the runs of a group.

    Raises:
        InputError: no folder, or one without a config or the metrics that are drawn.
    """
    if not folders:
        raise InputError(f"{name}: no runs to draw")
    files = [Path(folder) / "config.yaml" for folder in folders]
    configs = [load_config(file, code=code) for file in files]
    published = {published_total(config) for config in configs}
    runs = []
    for folder in folders:
        path = Path(folder) / "metrics.csv"
        columns = read_metrics(path)
        missing = [column for column in (*ACROSS, "lap_total") if column not in columns]
        if missing:
            raise InputError(f"{path}: no column {', '.join(missing)}")
        runs.append(columns)
    reference = published.pop() if len(published) == 1 else None
    scores = " and ".join(sorted({SCORES[config.run.score] for config in configs}))
    return Group(name, tuple(runs), configs[0].evaluate.length, scores, reference)


def spread(
    along: Sequence[np.ndarray], times: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Median and range of the times of several seeds at every point where one of them changes.

    Args:
        along: seconds or steps of each seed's measurements, rising, (rows,) each.
        times: measured there, s, (rows,) each; not finite where there is no time.

    Returns:
        The points (points,); median, lowest and highest time (points,): NaN where fewer than half
        of the seeds have a time (median), or none has.
    """
    points = np.unique(np.concatenate(along))
    latest = np.stack([_latest(points, x, y) for x, y in zip(along, times, strict=True)])
    latest.sort(axis=0)  # no time, infinite, comes last
    count = len(latest)
    low, high = latest[(count - 1) // 2], latest[count // 2]
    median = np.where(np.isfinite(high), 0.5 * (low + high), low)
    highest = np.where(np.isfinite(latest), latest, -np.inf).max(axis=0)
    middle, low, high = (np.where(np.isfinite(x), x, np.nan) for x in (median, latest[0], highest))
    return points, middle, low, high


def _latest(points: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The time (points,) measured last at or before each point; infinite where there is none."""
    padded = np.append(np.inf, np.where(np.isfinite(y), y, np.inf))
    return padded[np.searchsorted(x, points, side="right")]


def _draw_group(axes: Axes, group: Group, along: str, unit: float, color: str) -> None:
    seeds = [(run[along] * unit, run["lap_total"]) for run in group.runs]
    points, median, lowest, highest = spread(*zip(*seeds, strict=True))
    label = f"{group.name} ({counted(len(seeds), 'seed')}, {group.scores})"
    axes.fill_between(points, lowest, highest, step="post", color=color, alpha=0.18, lw=0)
    axes.plot(points, median, drawstyle="steps-post", color=color, lw=1.6, label=label)
