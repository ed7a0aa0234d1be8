"""Training curves from the metrics of one or several runs."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.core.errors import InputError
from quadjax.evaluation.figures import INK, MUTED, SERIES, new_figure, tidy

Metrics = Mapping[str, np.ndarray]  # column name -> (rows,)
ACROSS = {"seconds": ("wall time (s)", 1.0), "steps": ("environment steps (millions)", 1e-6)}
UPWARDS = {"reward": "reward per step", "lap_total": "all laps (s)", "crash_rate": "crash rate"}
LAP_RANGE = 1.6  # the lap axis ends at so many times the best


def training_figure(
    runs: Mapping[str, Metrics], title: str = "", reference: tuple[str, float] | None = None
) -> Figure:
    """Reward, lap time and crash rate against wall time and environment steps.

    Draws those of the columns ``reward``, ``lap_total`` and ``crash_rate`` that the first run has,
    against ``seconds`` and ``steps``.

    Args:
        runs: metrics by the name of their run.
        title: over the picture.
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
    if len(runs) > 1:
        grid[0][-1].legend(loc="lower right", frameon=False, labelcolor=INK, fontsize=8)
    grid[0][0].set_title(title, color=INK, fontsize=13, loc="left", pad=10)
    return figure


def _draw_runs(axes: Axes, runs: Mapping[str, Metrics], along: str, up: str) -> None:
    for index, (name, columns) in enumerate(runs.items()):
        if along not in columns or up not in columns:
            continue
        x, y = columns[along] * ACROSS[along][1], columns[up]
        fine = np.isfinite(x) & np.isfinite(y)
        colour = SERIES[index % len(SERIES)]
        mark = "o" if up == "lap_total" or np.count_nonzero(fine) == 1 else None
        axes.plot(x[fine], y[fine], color=colour, lw=1.5, marker=mark, markersize=3, label=name)


def lap_axis(axes: Axes, times: np.ndarray, references: Sequence[tuple[str, float]]) -> None:
    """Show the times near the best one; the first laps ever flown are far off and say little.

    Args:
        axes: with times upwards, s.
        times: all that is drawn, s; what is not finite is not.
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
