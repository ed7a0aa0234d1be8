"""Time of all laps against seconds of flight, over several plants."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from quadjax.core.plotting import INK, SERIES, head, new_figure, tidy

FAINT = 0.35  # opacity of one plant


def improvement_figure(results: Mapping[str, Sequence[Mapping[str, Any]]]) -> Figure:
    """What learning from flights changed, by policy.

    Thin lines are plants: from the check flights before the first round over the flights of the
    later rounds to the check flights after the last one. A plant without a flight that finished
    has no point. Thick lines are means over all plants, where each has a point.

    Args:
        results: content of ``plants.json`` by the label of the policy.
    """
    figure = new_figure(9.6, 4.0)
    times, shares = figure.subplots(1, 2)
    for (label, plants), color in zip(results.items(), SERIES, strict=False):
        curves = [_curve(plant) for plant in plants]
        for flight, time, _ in curves:
            times.plot(flight, time, "o-", color=color, alpha=FAINT, markersize=3, linewidth=0.8)
        flight, time, share = np.mean(np.array(curves), axis=0)
        known = np.isfinite(time)
        times.plot(flight[known], time[known], "o-", color=color, linewidth=2.2, label=label)
        shares.plot(flight, 100.0 * share, "o-", color=color, linewidth=2.2, label=label)
        _own(times, plants, float(flight[-1]), color)
    _dress(times, "time of all laps, s")
    _dress(shares, "flights that finish, %")
    shares.set_ylim(-3.0, 103.0)
    return figure


def _curve(plant: Mapping[str, Any]) -> tuple[list[float], list[float], list[float]]:
    """Seconds of flight, mean time of all laps, and share of finished flights, by round."""
    flown = [plant["check"]["before"]]
    flown += [done["flown"] for done in plant["rounds"][1:]]
    flown.append(plant["check"]["after"])
    used = np.cumsum([0.0, *(sum(done["flown"]["seconds"]) for done in plant["rounds"])])
    return list(map(float, used)), [_mean(own) for own in flown], [_share(own) for own in flown]


def _own(axes: Axes, plants: Sequence[Mapping[str, Any]], flight: float, color: str) -> None:
    """The mean of the policies that are trained on the plants' own numbers."""
    known = [plant["check"]["reference"] for plant in plants if "reference" in plant["check"]]
    if known:
        mean = float(np.mean([_mean(own) for own in known]))
        label = "trained on the plant's own numbers"
        axes.plot([0.0, flight], [mean, mean], "--", color=color, linewidth=1.2, label=label)


def _mean(flown: Mapping[str, Any]) -> float:
    totals = [total for total in flown["totals"] if total is not None]
    return float(np.mean(totals)) if totals else float("nan")


def _share(flown: Mapping[str, Any]) -> float:
    return float(np.mean([total is not None for total in flown["totals"]]))


def _dress(axes: Axes, name: str) -> None:
    tidy(axes)
    axes.set_xlabel("flight that was learned from, s", color=INK)
    axes.set_ylabel(name, color=INK)
    head(axes, columns=2)
