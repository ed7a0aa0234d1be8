"""Learning curves over seeds: how long the laps take as training goes on, group by group."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.config.loading import load_config
from quadjax.core.errors import InputError
from quadjax.evaluation.curves import ACROSS, lap_axis
from quadjax.evaluation.figures import INK, SERIES, new_figure, tidy
from quadjax.evaluation.tables import counted
from quadjax.training.metrics import read_metrics
from quadjax.training.paper import published_total

COLOURS = (*SERIES, "#7b4fa3", "#5b6770", "#8c5a2b", "#c2569b")


@dataclasses.dataclass(frozen=True)
class Group:
    """Runs of one config over several seeds."""

    name: str
    runs: tuple[Mapping[str, np.ndarray], ...]  # columns of each run's metrics, (rows,) each
    laps: int  # that a flight has
    published: tuple[str, float] | None  # label and time, s, where it is the published race


def learning_figure(groups: Mapping[str, Sequence[Path]]) -> Figure:
    """Deterministic lap times of training runs against wall time and environment steps.

    One colour per group: its median over seeds as a line, from lowest to highest shaded. A seed
    has the time of its latest policy, and none before its first or while its policy does not fly
    every lap; none counts as slower than any. So there is a line where at least half of the seeds
    have a time, and it never gets better by leaving out the slow ones. The shade is of those that
    have one.

    Args:
        groups: run folders, with ``config.yaml`` and ``metrics.csv``, by the name of their group.

    Raises:
        InputError: a folder without them, flights of different numbers of laps, no group or more
            than there are colours.
    """
    if not 0 < len(groups) <= len(COLOURS):
        raise InputError(f"{len(groups)} groups of runs to draw, allowed: 1 to {len(COLOURS)}")
    drawn = [read_group(name, folders) for name, folders in groups.items()]
    check_laps({group.name: group.laps for group in drawn})
    figure = new_figure(9.8, 4.2)
    panels = figure.subplots(1, len(ACROSS), sharey=True)
    references = list(dict.fromkeys(group.published for group in drawn if group.published))
    times = np.concatenate([run["lap_total"] for group in drawn for run in group.runs])
    for axes, (along, (label, unit)) in zip(panels, ACROSS.items(), strict=True):
        tidy(axes)
        for group, colour in zip(drawn, COLOURS, strict=False):
            _draw_group(axes, group, along, unit, colour)
        lap_axis(axes, times, references)
        axes.set_xlabel(label, color=INK)
        axes.set_xlim(left=0.0)
    panels[0].set_ylabel(f"{counted(drawn[0].laps, 'lap')}, deterministic (s)", color=INK)
    title = "median over seeds; shaded from the fastest to the slowest"
    panels[0].set_title(title, color=INK, fontsize=11, loc="left", pad=10)
    panels[-1].legend(loc="upper right", frameon=False, labelcolor=INK, fontsize=8)
    return figure


def check_laps(laps: Mapping[str, int]) -> None:
    """Raise an ``InputError`` where not all, by name, fly as many laps."""
    if len(set(laps.values())) > 1:
        each = ", ".join(f"{name} {counted(number, 'lap')}" for name, number in laps.items())
        raise InputError(f"times of different numbers of laps have no axis in common: {each}")


def read_group(name: str, folders: Sequence[Path]) -> Group:
    """Runs as their folders have them.

    Raises:
        InputError: no folder, or one without a config or the metrics that are drawn.
    """
    if not folders:
        raise InputError(f"{name}: no runs to draw")
    config = load_config(Path(folders[0]) / "config.yaml")
    runs = []
    for folder in folders:
        path = Path(folder) / "metrics.csv"
        columns = read_metrics(path)
        missing = [column for column in (*ACROSS, "lap_total") if column not in columns]
        if missing:
            raise InputError(f"{path}: no column {', '.join(missing)}")
        runs.append(columns)
    return Group(name, tuple(runs), config.evaluate.laps, published_total(config))


def spread(
    along: Sequence[np.ndarray], times: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What several seeds' times come to wherever one of them changes.

    Args:
        along: seconds or steps of each seed's measurements, rising, (rows,) each.
        times: what was measured there, s, (rows,) each; not finite where there is no time.

    Returns:
        All the places (points,), and there the median, the lowest and the highest (points,): NaN
        where fewer than half of the seeds have a time, or none has.
    """
    points = np.unique(np.concatenate(along))
    latest = np.stack([_latest(points, x, y) for x, y in zip(along, times, strict=True)])
    latest.sort(axis=0)  # no time, infinite, comes last
    count = len(latest)
    low, high = latest[(count - 1) // 2], latest[count // 2]
    median = np.where(np.isfinite(high), 0.5 * (low + high), low)
    highest = np.where(np.isfinite(latest), latest, -np.inf).max(axis=0)
    return points, *(np.where(np.isfinite(x), x, np.nan) for x in (median, latest[0], highest))


def _latest(points: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """The time (points,) measured last at or before each point; infinite where there is none."""
    padded = np.append(np.inf, np.where(np.isfinite(y), y, np.inf))
    return padded[np.searchsorted(x, points, side="right")]


def _draw_group(axes: Axes, group: Group, along: str, unit: float, colour: str) -> None:
    seeds = [(run[along] * unit, run["lap_total"]) for run in group.runs]
    points, median, lowest, highest = spread(*zip(*seeds, strict=True))
    label = f"{group.name} ({counted(len(seeds), 'seed')})"
    axes.fill_between(points, lowest, highest, step="post", color=colour, alpha=0.18, lw=0)
    axes.plot(points, median, drawstyle="steps-post", color=colour, lw=1.6, label=label)
