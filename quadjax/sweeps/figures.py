"""Figures of a sweep's trials: each key alone, all keys at once, and how much each one explains."""

import dataclasses
import json
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import optuna
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator
from optuna.distributions import CategoricalDistribution, IntDistribution
from optuna.trial import FrozenTrial

from quadjax.core.plotting import INK, MUTED, SERIES, SPEED_COLORS, head, headline, new_figure, tidy

COLUMNS = 3  # panels of slices in a row, at most
TICKS = 4  # numbers on the axis of a key, about
VALUE = "all laps (s)"


@dataclasses.dataclass(frozen=True)
class _Key:
    """One key of the space, and where the trials are on its axis."""

    name: str
    places: np.ndarray  # (trials,) from 0, the lowest value or the first choice, to 1
    ticks: list[tuple[float, str]]  # places and texts

    @property
    def title(self) -> str:
        """The key in two lines, which need half the width."""
        section, dot, last = self.name.rpartition(".")
        return f"{section}{dot}\n{last}" if dot else last


def figures(trials: Sequence[FrozenTrial], title: str) -> dict[str, Figure]:
    """Figures by name: ``slices``, ``parallel`` and ``importances``.

    Args:
        trials: complete ones, at least one.
        title: of each figure.

    Returns:
        Without ``importances`` where fewer than three trials have different values.
    """
    keys = [_key(name, trials) for name in trials[0].params]
    values = np.array([trial.values[0] for trial in trials])
    drawn = {"slices": _slices(keys, values, title), "parallel": _parallel(keys, values, title)}
    if len(keys) > 1 and len(shares := _importances(trials)) > 1:
        drawn["importances"] = _bars(shares, title)
    return drawn


def _key(name: str, trials: Sequence[FrozenTrial]) -> _Key:
    kind: Any = trials[0].distributions[name]
    values = [trial.params[name] for trial in trials]
    if isinstance(kind, CategoricalDistribution):
        choices = list(kind.choices)
        last = max(len(choices) - 1, 1)
        places = np.array([choices.index(value) / last for value in values])
        return _Key(name, places, [(i / last, _text(x)) for i, x in enumerate(choices)])
    scale = np.log if kind.log else np.asarray
    low, high = scale(kind.low), scale(kind.high)

    def places_of(numbers: Sequence[float]) -> np.ndarray:
        return (scale(numbers) - low) / (high - low or 1.0)

    ticks = _ticks(kind)
    texts = [f"{number:g}" for number in ticks]
    return _Key(name, places_of(values), [*zip(places_of(ticks), texts, strict=True)])


def _ticks(kind: Any) -> list[float]:
    """Round numbers of a range, three at least; of a log range as few of them as possible."""
    factors = ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0)) if kind.log else ()
    whole = isinstance(kind, IntDistribution)
    even = MaxNLocator(TICKS, steps=[1, 2, 2.5, 5, 10], integer=whole, min_n_ticks=2)
    for locator in (*(LogLocator(subs=each) for each in factors), even):
        ticks = locator.tick_values(kind.low, kind.high)
        ticks = ticks[(ticks >= kind.low * 0.999) & (ticks <= kind.high * 1.001)]
        if len(ticks) >= 3:
            break
    return list(ticks)


def _text(choice: Any) -> str:
    """A choice as in the sweep file; a list, which Optuna stores as text, in short."""
    text = choice if isinstance(choice, str) else json.dumps(choice)
    return text.replace(", ", ",") if len(text) <= 24 else f"{text[:21]}..."


def _slices(keys: Sequence[_Key], values: np.ndarray, title: str) -> Figure:
    """The value of each trial over each key."""
    rows = -(-len(keys) // COLUMNS)
    columns = -(-len(keys) // rows)
    figure = new_figure(3.4 * columns + 0.8, 2.9 * rows + 0.6)
    headline(figure, title)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    best = values.argmin()
    for key, axes in zip(keys, grid, strict=False):
        tidy(axes)
        axes.scatter(key.places, values, s=26, color=SERIES[0], alpha=0.75, linewidths=0)
        axes.scatter(key.places[best], values[best], s=60, color=SERIES[1], zorder=3)
        _label(axes, key)
    for axes in grid[::columns]:
        axes.set_ylabel(VALUE, color=INK)
    for axes in grid[len(keys) :]:
        axes.set_visible(False)
    return figure


def _label(axes: Axes, key: _Key) -> None:
    """Ticks and name of a key below the axes."""
    longest = max(len(text) for _, text in key.ticks) * len(key.ticks)
    places, texts = zip(*key.ticks, strict=True)
    turned: dict[str, Any] = {"rotation": 30, "ha": "right", "rotation_mode": "anchor"}
    turned = turned if longest > 30 else {}
    axes.set_xticks(places, texts, **turned)
    axes.set_xlim(-0.06, 1.06)
    axes.set_xlabel(key.name, color=INK)


def _parallel(keys: Sequence[_Key], values: np.ndarray, title: str) -> Figure:
    """A line for each trial through its keys, colored by its value; the best one is thick."""
    figure = new_figure(max(6.4, 1.9 * len(keys) + 2.4), 4.6)
    axes = figure.subplots()
    low, high = values.min(), values.max()
    scale = Normalize(low, high if high > low else low + 1e-3)
    along = np.arange(len(keys) + 1)
    for index in np.argsort(-values):
        places = [*(key.places[index] for key in keys), scale(values[index])]
        is_best = index == values.argmin()
        style: dict[str, Any] = {"linewidth": 1.2, "alpha": 0.8}
        style = {"linewidth": 3.0, "zorder": 3} if is_best else style
        axes.plot(along, places, color=SPEED_COLORS(scale(values[index])), **style)
    for x, key in enumerate(keys):
        axes.axvline(x, color=MUTED, linewidth=0.8)
        for place, text in key.ticks:
            axes.annotate(
                text, (x, place), (5, 0), textcoords="offset points", va="center", fontsize=8,
                color=INK, bbox={"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.8},
                zorder=4,
            )  # fmt: skip
    axes.axvline(len(keys), color=MUTED, linewidth=0.8)
    axes.set_xticks(along, [*(key.title for key in keys), VALUE], color=INK, fontsize=9)
    axes.set_yticks([])
    axes.set(xlim=(-0.1, len(keys) + 0.02), ylim=(-0.04, 1.04))
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(ScalarMappable(scale, SPEED_COLORS), ax=axes, pad=0.01)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=INK, labelsize=9)
    head(axes, title)
    return figure


def _importances(trials: Sequence[FrozenTrial]) -> dict[str, float]:
    """The share of the variance that each key explains, by PED-ANOVA (Watanabe et al., 2023)."""
    study = optuna.create_study()
    study.add_trials(trials)
    evaluator = optuna.importance.PedAnovaImportanceEvaluator()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return optuna.importance.get_param_importances(study, evaluator=evaluator)
    except (RuntimeError, ValueError):  # fewer than three different values
        return {}


def _bars(shares: dict[str, float], title: str) -> Figure:
    """A bar for each key, the largest one on top."""
    names = sorted(shares, key=lambda name: shares[name])
    figure = new_figure(7.2, 1.2 + 0.42 * len(names))
    axes = figure.subplots()
    tidy(axes)
    bars = axes.barh(names, [100.0 * shares[name] for name in names], color=SERIES[0], height=0.6)
    axes.bar_label(bars, fmt="%.0f%%", padding=3, color=INK, fontsize=9)
    axes.set_xlabel("explained part of the variance (%)", color=INK)
    axes.margins(x=0.1)
    axes.grid(visible=False, axis="y")
    head(axes, title)
    return figure
