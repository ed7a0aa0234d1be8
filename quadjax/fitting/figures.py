"""Figures of a fit: measured, nominal and nominal plus residual against time, and errors."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from quadjax.core.files import whole_file
from quadjax.fitting.nominal import AXES, UNITS
from quadjax.fitting.pipeline import FitResult, Judged, pooled

COLOURS = {"measured": "0.35", "nominal": "tab:orange", "nominal + residual": "tab:blue"}
POINTS = 1500  # of a trace, at most


def write_figures(result: FitResult, folder: Path) -> list[Path]:
    """Write every figure; what was written."""
    written = []
    for judged in result.held_out:
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in judged.name)
        written.append(folder / f"held_out_{name}.png")
        _save(traces_figure(result, judged, f"held out: {judged.name}"), written[-1])
    for index, log in enumerate(result.logs):
        part = _of_flight(result, index)
        if len(part.rows):
            written.append(folder / f"training_{log.name}.png")
            _save(traces_figure(result, part, f"training: {log.name}"), written[-1])
    written.append(folder / "errors.png")
    _save(errors_figure(result), written[-1])
    return written


def _of_flight(result: FitResult, index: int) -> Judged:
    training = result.training
    here = result.samples.flight[training.rows] == index
    parts = (training.rows, training.measured, training.nominal, training.full)
    return Judged(result.logs[index].name, *(part[here] for part in parts))


def traces_figure(result: FitResult, judged: Judged, title: str = "") -> Figure:
    """Measured, nominal and nominal plus residual against time, a panel for each of ``AXES``.

    Args:
        result: of the fit.
        judged: the rows to draw, such as one of ``result.held_out``.
        title: over the picture.
    """
    figure = _new_figure(10, 12)
    axes = figure.subplots(len(AXES), 1, sharex=True)
    time = result.samples.time[judged.rows]
    every = max(1, len(time) // POINTS)
    series = (judged.measured, judged.nominal, judged.full)
    # Lines break where the rows jump: another flight of the group, or a pause on the ground.
    jump = np.flatnonzero(np.abs(np.diff(time[::every])) > 0.5)
    for i, axis in enumerate(AXES):
        for (label, colour), values in zip(COLOURS.items(), series, strict=True):
            line = np.insert(values[::every, i], jump + 1, np.nan)
            axes[i].plot(
                np.insert(time[::every], jump + 1, np.nan), line, color=colour, label=label, lw=0.9
            )
        axes[i].set_ylabel(f"{axis}, {UNITS[axis]}")
        axes[i].grid(alpha=0.3)
    axes[0].set_title(title)
    axes[0].legend(loc="upper right", ncols=3, fontsize=8)
    axes[-1].set_xlabel("time, s")
    return figure


def errors_figure(result: FitResult) -> Figure:
    """Histograms of both models' errors: in training and, where there are any, on held-out rows."""
    sets = {"training": result.training}
    if result.held_out:
        sets["held out"] = pooled(result.held_out)
    figure = _new_figure(16, 3.2 * len(sets))
    axes = figure.subplots(len(sets), len(AXES), squeeze=False)
    for row, (title, judged) in enumerate(sets.items()):
        for i, axis in enumerate(AXES):
            errors = {
                "nominal": judged.measured[:, i] - judged.nominal[:, i],
                "nominal + residual": judged.measured[:, i] - judged.full[:, i],
            }
            limit = max(float(np.percentile(np.abs(errors["nominal"]), 99.5)), 1e-12)
            bins = np.linspace(-limit, limit, 61)
            for label, error in errors.items():
                axes[row, i].hist(
                    error, bins, histtype="step", density=True, label=label, color=COLOURS[label]
                )
            axes[row, i].set_yticks([])
            axes[row, i].set_xlabel(f"error of {axis}, {UNITS[axis]}")
        axes[row, 0].set_ylabel(title)
    axes[0, 0].legend(fontsize=7)
    return figure


def _new_figure(width: float, height: float) -> Figure:
    """An empty figure, inches, that leaves the caller's choice of a backend alone."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _save(figure: Figure, path: Path) -> None:
    with whole_file(path) as temporary:
        figure.savefig(temporary, dpi=80, format="png")
