"""Figures of a sweep: parallel coordinates of its trials, and a slice along every key."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from quadjax.evaluation.figures import INK, MUTED, SERIES, SPEED_COLOURS, new_figure, tidy
from quadjax.sweeps.schema import Sweep
from quadjax.sweeps.space import Dimension

if TYPE_CHECKING:
    from quadjax.sweeps.report import TrialResult

COLOURS = SPEED_COLOURS.reversed()  # the best stand out
WORST = 0.9  # quantile of the values at which colours and axes end: a crash is far off


def place(d: Dimension, value: object) -> float:
    """Where a value lies on its dimension's axis, 0 to 1."""
    if d.kind == "choices":
        return d.labels().index(value) / max(1, len(d.choices) - 1)
    low, high, x = d.low, d.high, float(value)
    if d.log:
        low, high, x = np.log(low), np.log(high), np.log(x)
    return float((x - low) / (high - low))


def value_range(values: Sequence[float]) -> tuple[float, float]:
    """Values between which colours tell trials apart."""
    low, high = float(np.min(values)), float(np.quantile(values, WORST))
    return low, max(high, low + 1e-6)


def parallel_figure(sweep: Sweep, results: Sequence["TrialResult"]) -> Figure:
    """A line per trial through its parameters to its value, the best on top.

    Args:
        sweep: whose dimensions are the axes.
        results: trials with a value, complete or pruned; pruned ones are dashed.
    """
    dimensions = sweep.dimensions
    low, high = value_range([r.value for r in results])
    figure = new_figure(1.5 * (len(dimensions) + 1) + 2.0, 4.2)
    axes = figure.add_subplot()
    colour = Normalize(low, high)
    for rank, r in enumerate(sorted(results, key=lambda r: -r.value)):
        heights = [place(d, r.params[d.key]) for d in dimensions]
        heights.append(min(1.0, (r.value - low) / (high - low)))
        axes.plot(
            range(len(heights)),
            heights,
            color=COLOURS(colour(r.value)),
            lw=1.3,
            alpha=0.85,
            ls="--" if r.state == "pruned" else "-",
            zorder=2 + rank,
        )
    for index, d in enumerate(dimensions):
        _axis(axes, index, d)
    last = len(dimensions)
    axes.axvline(last, color=MUTED, lw=1.0)
    for height, value in ((0.0, low), (1.0, high)):
        _note(axes, last, height, f"{value:.2f}" + (" or more" if height else ""))
    names = [d.key.replace(".", ".\n") for d in dimensions]
    axes.set_xticks(range(last + 1), [*names, "median (s)"], fontsize=8, color=INK)
    axes.set_yticks([])
    axes.set_ylim(-0.08, 1.08)
    axes.spines[:].set_visible(False)
    axes.set_title(sweep.file.name, color=INK, fontsize=13, loc="left", pad=10)
    bar = figure.colorbar(ScalarMappable(colour, COLOURS), ax=axes, pad=0.02, extend="max")
    bar.set_label("median over seeds (s)", color=INK)
    bar.outline.set_visible(False)
    return figure


def _axis(axes: Axes, index: int, d: Dimension) -> None:
    axes.axvline(index, color=MUTED, lw=1.0, zorder=1)
    if d.kind == "choices":
        for label in d.labels():
            _note(axes, index, place(d, label), str(label))
        return
    for height, value in ((0.0, d.low), (1.0, d.high)):
        _note(axes, index, height, f"{value:.4g}")


def _note(axes: Axes, x: float, y: float, text: str) -> None:
    axes.annotate(
        text,
        xy=(x, y),
        xytext=(3, 3),
        textcoords="offset points",
        fontsize=7,
        color=INK,
        zorder=10_000,
    )


def slice_figure(sweep: Sweep, results: Sequence["TrialResult"]) -> Figure:
    """Every trial's value against each parameter by itself.

    Args:
        sweep: whose dimensions are the panels.
        results: trials with a value, complete or pruned; pruned ones are hollow.
    """
    dimensions = sweep.dimensions
    columns = min(4, len(dimensions))
    lines = -(-len(dimensions) // columns)
    figure = new_figure(2.9 * columns + 0.6, 2.5 * lines + 0.5)
    grid = figure.subplots(lines, columns, sharey=True, squeeze=False)
    low, high = value_range([r.value for r in results])
    margin = 0.05 * (high - low)
    for axes, d in zip(grid.flat, dimensions, strict=False):
        tidy(axes)
        for state, face in (("complete", SERIES[0]), ("pruned", "none")):
            chosen = [r for r in results if r.state == state]
            where = [_across(d, r.params[d.key]) for r in chosen]
            heights = [min(r.value, high + margin) for r in chosen]
            axes.scatter(where, heights, s=22, facecolors=face, edgecolors=SERIES[0], lw=0.9)
        if d.kind == "choices":
            labels = [str(label) for label in d.labels()]
            axes.set_xticks(range(len(labels)), labels, fontsize=7)
            axes.set_xlim(-0.5, len(labels) - 0.5)
        elif d.log:
            _log_axis(axes)
        axes.set_xlabel(d.key, color=INK, fontsize=9)
        axes.set_ylim(low - margin, high + 2 * margin)
    for axes in list(grid.flat)[len(dimensions) :]:
        axes.set_visible(False)
    for line in grid:
        line[0].set_ylabel("median (s)", color=INK)
    grid[0][0].set_title(sweep.file.name, color=INK, fontsize=13, loc="left", pad=10)
    return figure


def _log_axis(axes: Axes) -> None:
    """A logarithmic axis of ones, twos and fives in plain numbers: decades are rare in a space."""
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())


def _across(d: Dimension, value: object) -> float:
    return float(d.labels().index(value)) if d.kind == "choices" else float(value)
