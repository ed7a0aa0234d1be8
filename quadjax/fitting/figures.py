"""Figures of a fit: signals against time, and histograms of errors."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, SERIES, head, new_figure, save_figure, tidy
from quadjax.fitting.axes import Prediction, pooled
from quadjax.fitting.fit import Fit
from quadjax.fitting.nominal import AXES, units
from quadjax.fitting.samples import ALL

COLORS = {"nominal": SERIES[3], "nominal + residual": SERIES[0]}
POINTS = 1500  # of a line, at most


def write_figures(result: Fit, folder: Path) -> list[Path]:
    """Write every figure; return the paths."""
    figures = {}
    for part in result.held_out:
        name = "".join(c if c.isalnum() or c in "-_" else "_" for c in part.name)
        figures[f"held_out_{name}"] = traces_figure(result, part, f"held out: {part.name}")
    for index, log in enumerate(result.logs):
        rows = result.samples.flight[result.training.rows] == index
        if rows.any():
            title = f"training: {log.name}"
            figures[f"training_{log.name}"] = traces_figure(result, result.training[rows], title)
    figures["errors"] = errors_figure(result)
    for name, figure in figures.items():
        save_figure(figure, folder / f"{name}.png", dpi=80)
    return [folder / f"{name}.png" for name in figures]


def traces_figure(result: Fit, part: Prediction, title: str = "") -> Figure:
    """Errors of the nominal model, and of it with the residual, against time; a panel per axis.

    The signals themselves differ by less than a line's width. Each panel has the RMSE of both.

    Args:
        result: of the fit.
        part: rows to draw, such as one of ``result.held_out``.
        title: of the figure.
    """
    figure = new_figure(10, 11)
    panels = figure.subplots(len(AXES), 1, sharex=True)
    time = result.samples.time[part.rows]
    every = max(1, len(time) // POINTS)
    # Break lines at jumps of time: another flight of the group, or a pause on the ground.
    jump = np.flatnonzero(np.abs(np.diff(time[::every])) > 0.5) + 1
    for i, (axis, axes) in enumerate(zip(AXES, panels, strict=True)):
        tidy(axes)
        unit, sizes = _unit(result, axis), []
        for label, model in _models(result, part):
            error = part.measured[:, i] - model[:, i]
            line = (np.insert(x, jump, np.nan) for x in (time[::every], error[::every]))
            axes.plot(*line, color=COLORS[label], label=label, lw=0.9)
            sizes.append(f"{np.sqrt(np.mean(error**2)):.3g}")
        axes.axhline(0.0, color=INK, lw=0.8)
        axes.set_ylabel(f"{axis} ({unit})", color=INK)
        note = f"RMSE {' → '.join(sizes)} {unit}"
        axes.set_title(note, loc="right", fontsize=8, color=INK, pad=2)
    head(panels[0], f"error of the model, {title}" if title else "error of the model")
    panels[-1].set_xlabel("time (s)", color=INK)
    return figure


def errors_figure(result: Fit) -> Figure:
    """Histograms of both models' errors on training rows and on held-out rows."""
    sets = {"training": result.training, "held out": pooled(result.held_out)}
    figure = new_figure(16, 3.2 * len(sets))
    panels = figure.subplots(len(sets), len(AXES), squeeze=False)
    for row, (title, part) in zip(panels, sets.items(), strict=True):
        for i, (axis, axes) in enumerate(zip(AXES, row, strict=True)):
            tidy(axes)
            models = _models(result, part)
            errors = {label: part.measured[:, i] - model[:, i] for label, model in models}
            limit = max(float(np.percentile(np.abs(errors["nominal"]), 99.5)), 1e-12)
            bins = np.linspace(-limit, limit, 61)
            for label, error in errors.items():
                axes.hist(
                    error, bins, histtype="step", density=True, label=label, color=COLORS[label]
                )
            axes.set_yticks([])
            axes.set_xlabel(f"error of {axis} ({_unit(result, axis)})", color=INK)
        row[0].set_ylabel(title, color=INK)
    handles = panels[0, 0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper right", ncols=2, fontsize=8, frameon=False)
    return figure


def _models(result: Fit, part: Prediction) -> list[tuple[str, np.ndarray]]:
    """What the models predict, by their labels: one where there is no residual."""
    return list(zip(COLORS, (part.nominal, part.full)[: 1 + bool(result.residuals)], strict=False))


def _unit(result: Fit, axis: str) -> str:
    return units(type(result.constants[ALL]))[axis].replace("^2", "²")
