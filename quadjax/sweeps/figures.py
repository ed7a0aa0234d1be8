"""The trials of a sweep against each of their parameters."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, SERIES, new_figure, tidy
from quadjax.evaluation.curves import lap_axis
from quadjax.sweeps.extra import optuna

ACROSS = 4  # panels of a row
Trial = optuna.trial.FrozenTrial


def slices_figure(trials: list[Trial]) -> Figure:
    """The value of each trial against each of its parameters, a panel for each key.

    The axis of times ends near the best one. Trials above it, and those in which a flight did not
    finish, whose value contains a penalty, are crosses at the upper edge. Pruned trials are hollow.

    Args:
        trials: with values, s.
    """
    keys = list(dict.fromkeys(key for trial in trials for key in trial.params))
    rows = -(-len(keys) // ACROSS)
    figure = new_figure(2.9 * min(len(keys), ACROSS) + 0.6, 2.7 * rows + 0.4)
    columns = min(len(keys), ACROSS)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    whole = [trial for trial in trials if _finished(trial)]
    times = np.array([trial.value for trial in whole], float)
    for axes, key in zip(grid.flat, keys, strict=False):
        tidy(axes)
        lap_axis(axes, times, [])
        _draw(axes, key, trials)
        axes.set_xlabel(key, color=INK)
    for axes in grid.flat[len(keys) :]:
        axes.set_visible(False)
    for line in grid:
        line[0].set_ylabel("median (s)", color=INK)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    first = dict(zip(labels, handles, strict=True))
    figure.legend(
        first.values(), first, loc="outside upper left", ncols=3, frameon=False, labelcolor=INK
    )
    return figure


def _finished(trial: Trial) -> bool:
    return trial.value is not None and trial.user_attrs.get("finished", 0.0) >= 1.0


def _draw(axes: Axes, key: str, trials: list[Trial]) -> None:
    own = [trial for trial in trials if key in trial.params]
    values: list[Any] = [trial.params[key] for trial in own]
    numeric = all(isinstance(x, (int, float)) and not isinstance(x, bool) for x in values)
    if numeric and len(set(values)) > 1 and min(values) > 0 and max(values) > 20 * min(values):
        axes.set_xscale("log")
    if not numeric:
        names = sorted({str(value) for value in values})
        axes.set_xticks(range(len(names)), names, fontsize=8)
        axes.set_xlim(-0.5, len(names) - 0.5)
        values = [names.index(str(value)) for value in values]
    top = axes.get_ylim()[1]
    for place, trial in zip(values, own, strict=True):
        pruned = trial.state == optuna.trial.TrialState.PRUNED
        if not _finished(trial) or float(trial.value) > top:
            style, label, height = {"marker": "x", "color": SERIES[1]}, "crashed or slower", top
        else:
            face = "none" if pruned else SERIES[0]
            style = {"marker": "o", "mec": SERIES[0], "mfc": face}
            label, height = "pruned" if pruned else "complete", float(trial.value)
        axes.plot(place, height, ls="none", ms=5, clip_on=False, label=label, **style)
    axes.set_ylim(top=top)
