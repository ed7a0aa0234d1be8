"""Figure of ``benchmarks.loop``: totals on each drone, and lap times, simulated and flown.

python -m benchmarks.loop_figure runs/loop docs/images/loop.png [--drones 1 2 3] [--seeds 0 1]
"""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.loop_results import E2E, LAPS, TUNED, Numbers, Read, means, reader
from quadjax.cli import script
from quadjax.core.plotting import INK, SERIES, head, new_figure, save_figure, tidy
from quadjax.evaluation.rows import interval


def loop_figure(
    folder: Path, file: Path, *, drones: Numbers = tuple(range(1, 11)), seeds: Numbers = (0,)
) -> None:
    """Draw the flights of E2E and tuned INDI."""
    save_figure(figure_of(reader(folder, drones, seeds), drones), file)


def figure_of(read: Read, drones: Sequence[int]) -> Figure:
    """Totals of each drone to the left, laps with 95% intervals over drones to the right."""
    figure = new_figure(9.6, 4.0)
    left, right = figure.subplots(1, 2)
    for name, color, shift in ((E2E, SERIES[0], -0.08), (TUNED, SERIES[1], 0.08)):
        for key, mark, line in (("simulated", "x", "--"), ("flown", "o", "-")):
            laps = means(read(name, key))
            label, places = f"{name.split(',')[0]}, {key}", np.arange(len(drones)) + 1 + shift
            left.plot(places, laps.sum(axis=1), mark, color=color, ms=6, label=label)
            middle, half = np.array([interval(lap) for lap in laps.T]).T
            style = {"color": color, "fmt": mark + line, "ms": 4, "capsize": 2}
            right.errorbar(np.arange(LAPS) + 1 + shift, middle, half, **style)
    for axes, x, y in ((left, "drone", "six laps (s)"), (right, "lap", "lap time (s)")):
        tidy(axes)
        axes.set_xlabel(x, color=INK)
        axes.set_ylabel(y, color=INK)
    left.set_xticks(np.arange(len(drones)) + 1, [f"{drone}" for drone in drones])
    head(left, columns=2)
    return figure


if __name__ == "__main__":
    script(loop_figure)
