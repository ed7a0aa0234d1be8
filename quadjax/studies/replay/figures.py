"""Figures of a replay: commands against time, and prediction errors against the horizon."""

import numpy as np
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, SERIES, head, new_figure, tidy
from quadjax.studies.replay.commands import Replayed
from quadjax.studies.replay.prediction import QUANTITIES, Prediction

POINTS = 4000  # of a line, at most


def commands_figure(time: np.ndarray, part: Replayed) -> Figure:
    """Logged commands and the policy's, a panel for each.

    Args:
        time: (n,) s.
        part: commands at these times.
    """
    count = len(part.names)
    figure = new_figure(10, 1.0 + 1.9 * count)
    panels = figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0]
    every = max(1, len(time) // POINTS)
    lines = {part.source: part.logged, "policy": part.policy, "policy, fixed point": part.fixed}
    styles = (("-", SERIES[3], 1.4), ("-", SERIES[0], 1.0), (":", SERIES[1], 1.0))
    for i, axes in enumerate(panels):
        tidy(axes)
        for (label, values), (style, color, width) in zip(lines.items(), styles, strict=True):
            if values is not None:
                shown = values[::every, i]
                axes.plot(time[::every], shown, style, color=color, lw=width, label=label)
        unit = f" ({part.units[i]})" if part.units[i] else ""
        axes.set_ylabel(f"{part.names[i]}{unit}", color=INK)
    head(panels[0], "commands in the logged states")
    panels[-1].set_xlabel("time (s)", color=INK)
    return figure


def prediction_figure(found: Prediction, model: str) -> Figure:
    """Root mean square errors against the horizon, with the range of 10 to 90% of the windows."""
    figure = new_figure(10, 6)
    panels = figure.subplots(2, 2, sharex=True).ravel()
    lines = {f"model {model}": (found.errors, SERIES[0]), "unchanged": (found.unchanged, SERIES[3])}
    for axes in panels:  # before the scales, which the panels share
        tidy(axes)
    for axes, (name, unit) in zip(panels, QUANTITIES.items(), strict=True):
        for label, (errors, color) in lines.items():
            values = np.maximum(errors[name], 1e-9)
            axes.plot(
                found.horizons, np.sqrt((values**2).mean(axis=0)), "o-", color=color, label=label
            )
            low, high = np.percentile(values, (10, 90), axis=0)
            axes.fill_between(found.horizons, low, high, color=color, alpha=0.15, lw=0)
        axes.set(xscale="log", yscale="log")
        axes.set_ylabel(f"error of {name} ({unit})", color=INK)
    head(panels[0], f"prediction, driven by the logged {found.drive}")
    for axes in panels[2:]:
        axes.set_xlabel("horizon (s)", color=INK)
    return figure
