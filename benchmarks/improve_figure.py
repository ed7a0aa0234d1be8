"""Time of all laps against seconds of flight, over several plants.

``python -m benchmarks.improve_figure FIGURE.png LABEL=FILE.json ...`` draws the files that
``benchmarks.improve_plants --json`` writes, one for each policy.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter
from matplotlib.figure import Figure

from quadjax.cli import options, script
from quadjax.core.errors import InputError
from quadjax.core.plotting import INK, SERIES, head, new_figure, save_figure, tidy

Plant = Mapping[str, Any]


def improvement_figure(results: Mapping[str, Sequence[Plant]]) -> Figure:
    """Time of all laps and finished flights against seconds of flight, by the label of a policy.

    Thin lines are plants, thick lines means over all plants where each has a finisher.
    """
    figure = new_figure(9.6, 4.0)
    times, shares = figure.subplots(1, 2)
    for (label, plants), color in zip(results.items(), SERIES, strict=False):
        curves = np.array([_curve(plant) for plant in plants])
        for flight, time, _ in curves:
            times.plot(flight, time, "o-", color=color, alpha=0.35, markersize=3, linewidth=0.8)
        flight, time, share = curves.mean(axis=0)
        known = np.isfinite(time)
        times.plot(flight[known], time[known], "o-", color=color, linewidth=2.2, label=label)
        shares.plot(flight, 100.0 * share, "o-", color=color, linewidth=2.2, label=label)
        reference = [p["check"]["reference"] for p in plants if "reference" in p["check"]]
        if reference:
            level = float(np.mean([mean(flown) for flown in reference]))
            text = "trained on the plant's own numbers"
            times.plot(flight[[0, -1]], [level, level], "--", color=color, lw=1.2, label=text)
    for axes, name in ((times, "time of all laps, s"), (shares, "flights that finish, %")):
        tidy(axes)
        axes.set_xlabel("flight that was learned from, s", color=INK)
        axes.set_ylabel(name, color=INK)
        head(axes, columns=2)
    shares.set_ylim(-3.0, 103.0)
    return figure


def _curve(plant: Plant) -> list[list[float]]:
    """Seconds of flight, mean time of all laps, and share of finished flights, by round."""
    rounds = [done["flown"] for done in plant["rounds"]]
    flown = [plant["check"]["before"], *rounds[1:], plant["check"]["after"]]
    used = np.cumsum([0.0, *(sum(each["seconds"]) for each in rounds)])
    shares = [np.mean([total is not None for total in each["totals"]]) for each in flown]
    return [list(map(float, used)), list(map(mean, flown)), list(map(float, shares))]


def mean(flown: Plant) -> float:
    """Mean time of all laps of the flights that finished, s."""
    done = [total for total in flown["totals"] if total is not None]
    return float(np.mean(done)) if done else float("nan")


def plants_of(argument: str) -> tuple[str, Sequence[Plant]]:
    """The label and the plants of an argument LABEL=FILE.json."""
    label, equals, file = argument.partition("=")
    if not (label and equals):
        raise InputError(f"{argument}: expected LABEL=FILE.json")
    try:
        plants = json.loads(Path(file).read_text(encoding="utf-8"))
        curves = [_curve(plant) for plant in plants]
    except (KeyError, TypeError, ValueError):
        curves = []
    if not curves:
        raise InputError(f"{file}: not a file of benchmarks.improve_plants --json")
    return label, plants


def improve_figure(
    figure: Annotated[Path, options.Output(options.PICTURES)],
    /,
    *files: Annotated[str, Parameter(name="LABEL=FILE.json", required=True)],
) -> None:
    """Draw the flights of one or more policies."""
    save_figure(improvement_figure(dict(map(plants_of, files))), figure)


if __name__ == "__main__":
    script(improve_figure)
