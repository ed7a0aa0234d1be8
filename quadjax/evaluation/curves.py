"""Training curves of one or several seeds against wall time and environment steps."""

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
X_AXES = {"seconds": ("wall time (s)", 1.0), "steps": ("environment steps (millions)", 1e-6)}
Y_AXES = {
    "reward": "reward per step",
    "lap_total": "score: all laps (s)",
    "episode_reward": "reward of an episode",
    "crash_rate": "crash rate",
}
LAP_RANGE = 1.6  # the lap axis ends at this multiple of the best time
COLORS = (*SERIES, "#7b4fa3", "#5b6770", "#8c5a2b", "#c2569b")
SCORES = {"mean": "mean action", "sampled": "sampled", "reward": "mean action"}  # by run.score


def training_figure(
    groups: Mapping[str, Metrics | Sequence[Metrics]],
    title: str = "",
    *references: tuple[str, float] | None,
    upwards: Mapping[str, str] = Y_AXES,
) -> Figure:
    """Reward, lap time and crash rate against wall time and environment steps.

    Each group has a color: the curve of its run, or for several seeds the median over them, and a
    band from the lowest to the highest. The value of a seed is that of its latest evaluation. A
    seed without a time (before its first evaluation, or if its policy does not complete every lap)
    counts as slower than any other, so the median exists where at least half of the seeds have a
    time. The band is of those that do.

    Args:
        groups: metrics of a run, or of several seeds, by name.
        title: of the figure.
        references: labels and times, s, to draw into the lap panels.
        upwards: columns and labels of the panels that are drawn, as far as the first run has them.

    Raises:
        InputError: none of the columns is there, no group or run, or more groups than colors.
    """
    if not 0 < len(groups) <= len(COLORS):
        raise InputError(f"{len(groups)} groups of runs to draw, allowed: 1 to {len(COLORS)}")
    metrics = {k: [runs] if isinstance(runs, Mapping) else runs for k, runs in groups.items()}
    first: Metrics = next((run for runs in metrics.values() for run in runs), {})
    across = [name for name in X_AXES if name in first]
    rows = [x for x in upwards if x in first and (len(upwards) == 1 or np.isfinite(first[x]).any())]
    if not across or not rows:
        raise InputError(
            f"metrics have the columns {', '.join(first) or 'none'}; expected one of "
            f"{', '.join(X_AXES)} and one of {', '.join(upwards)}"
        )
    figure = new_figure(4.6 * len(across) + 0.6, max(4.2, 2.1 * len(rows) + 0.7))
    grid = figure.subplots(len(rows), len(across), sharex="col", sharey="row", squeeze=False)
    for up, line in zip(rows, grid, strict=True):
        for along, axes in zip(across, line, strict=True):
            tidy(axes)
            for (name, runs), color in zip(metrics.items(), COLORS, strict=False):
                runs = [run for run in runs if along in run and up in run]
                _draw_runs(axes, runs, along, up, color, name if name != title else "")
            if up == "lap_total":
                times = np.concatenate([run[up] for runs in metrics.values() for run in runs])
                _lap_axis(axes, times, [reference for reference in references if reference])
        line[0].set_ylabel(upwards[up], color=INK)
    for along, axes in zip(across, grid[-1], strict=True):
        axes.set_xlabel(X_AXES[along][0], color=INK)
        axes.set_xlim(left=0.0)
    head(grid[0][0], title, columns=3)
    return figure


def _draw_runs(
    axes: Axes, runs: Sequence[Metrics], along: str, up: str, color: str, label: str
) -> None:
    unit = X_AXES[along][1]
    if len(runs) == 1:
        x, y = runs[0][along] * unit, runs[0][up]
        fine = np.isfinite(x) & np.isfinite(y)
        mark = "o" if up == "lap_total" or np.count_nonzero(fine) == 1 else None
        axes.plot(x[fine], y[fine], color=color, lw=1.5, marker=mark, markersize=3, label=label)
    elif runs:
        seeds = [run[along] * unit for run in runs]
        points, median, lowest, highest = spread(seeds, [run[up] for run in runs])
        axes.fill_between(points, lowest, highest, step="post", color=color, alpha=0.18, lw=0)
        axes.plot(points, median, drawstyle="steps-post", color=color, lw=1.6, label=label)


def _lap_axis(axes: Axes, times: np.ndarray, references: Sequence[tuple[str, float]]) -> None:
    """Draw the references, and limit the axis to times near the best: the first are much slower."""
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
    values = [*times[np.isfinite(times)], *(time for _, time in references)]
    if values:
        axes.set_ylim(0.97 * min(values), min(1.03 * max(values), LAP_RANGE * min(values)))
    if not np.isfinite(times).any():
        middle: dict[str, Any] = {"ha": "center", "va": "center", "transform": axes.transAxes}
        axes.text(0.5, 0.5, "no run completed its laps", color=MUTED, fontsize=10, **middle)
        axes.set_yticks(axes.get_yticks() if values else [])


def learning_figure(groups: Mapping[str, Sequence[Path]], code: Collection[str] = ()) -> Figure:
    """Scores of training runs of several seeds (see ``run.score``), as of ``training_figure``.

    Args:
        groups: run folders, with ``config.yaml`` and ``metrics.csv``, by the name of their group.
        code: names ``module:OBJECT`` that may be imported from the runs' configs.

    Raises:
        InputError: a folder without them, runs of different scores or numbers of laps, no group,
            or more groups than colors.
    """
    metrics: dict[str, list[Metrics]] = {}
    lengths, published = {}, []
    for name, folders in groups.items():
        if not folders:
            raise InputError(f"{name}: no runs to draw")
        configs = [load_config(Path(folder) / "config.yaml", code=code) for folder in folders]
        scores = " and ".join(sorted({SCORES[config.run.score] for config in configs}))
        label = f"{name} ({counted(len(folders), 'seed')}, {scores})"
        score = configs[0].run.score_name
        metrics[label] = [_metrics(Path(folder) / "metrics.csv", score) for folder in folders]
        lengths[name] = configs[0].evaluate.length
        published += [published_total(config) for config in configs]
    check_lengths(lengths)
    references = dict.fromkeys(published) if all(published) else ()
    laps = {"lap_total": f"score: {next(iter(lengths.values()), '')} (s)"}
    upwards = {score: (Y_AXES | laps)[score]}
    title = "median over seeds; shaded from the fastest to the slowest"
    return training_figure(metrics, title, *references, upwards=upwards)


def _metrics(path: Path, score: str) -> Metrics:
    columns = read_metrics(path)
    missing = [column for column in (*X_AXES, score) if column not in columns]
    if missing:
        raise InputError(f"{path}: no column {', '.join(missing)}")
    return columns


def check_lengths(lengths: Mapping[str, str]) -> None:
    """Raise an ``InputError`` if the lengths of races, by name, differ."""
    if len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise InputError(f"times of different numbers of laps cannot be compared: {listed}")


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
    points, columns = np.unique(np.concatenate(along)), []
    for x, y in zip(along, times, strict=True):  # infinite where there is no time yet
        padded = np.append(np.inf, np.where(np.isfinite(y), y, np.inf))
        columns.append(padded[np.searchsorted(x, points, side="right")])
    latest = np.sort(columns, axis=0)
    low, high = latest[(len(latest) - 1) // 2], latest[len(latest) // 2]
    median = np.where(np.isfinite(high), 0.5 * (low + high), low)
    highest = np.where(np.isfinite(latest), latest, -np.inf).max(axis=0)
    middle, low, high = (np.where(np.isfinite(x), x, np.nan) for x in (median, latest[0], highest))
    return points, middle, low, high
