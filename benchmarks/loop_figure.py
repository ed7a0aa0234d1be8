"""Figure of ``benchmarks.loop``: totals on each drone, and against the thrust of the flights.

python -m benchmarks.loop_figure runs/loop docs/images/loop.png [--drones 1 2 3] [--seeds 0 1]
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.figure import Figure

from benchmarks.loop_results import E2E, TUNED, Read, means, reader
from quadjax.cli import script
from quadjax.cli.options import PICTURES, Output, Seeds
from quadjax.core.plotting import INK, SERIES, head, new_figure, save_figure, tidy


def loop_figure(
    folder: Path,
    file: Annotated[Path, Output(PICTURES)],
    *,
    drones: Seeds = tuple(range(1, 11)),
    seeds: Seeds = (0,),
) -> None:
    """Draw the flights of E2E and tuned INDI."""
    save_figure(figure_of(reader(folder, drones, seeds), drones), file)


def figure_of(read: Read, drones: Sequence[int]) -> Figure:
    """Totals on each drone to the left; those flown against the mean thrust to the right."""
    figure = new_figure(9.6, 4.0)
    left, right = figure.subplots(1, 2, sharey=True)
    for name, color in ((E2E, SERIES[0]), (TUNED, SERIES[1])):
        for key, mark in (("simulated", "x"), ("flown", "o")):
            totals, label = means(read(name, key)).sum(axis=1), f"{name.split(',')[0]}, {key}"
            left.plot(np.arange(len(drones)) + 1, totals, mark, color=color, ms=6, label=label)
        thrust = [np.nan if x is None else x.mean() for x in read(name, "thrust")]
        right.plot(thrust, totals, "o", color=color, ms=6)
    for axes, x in ((left, "drone"), (right, "mean specific thrust in flight (m/s²)")):
        tidy(axes)
        axes.set_xlabel(x, color=INK)
    left.set_ylabel("six laps (s)", color=INK)
    left.set_xticks(np.arange(len(drones)) + 1, [f"{drone}" for drone in drones])
    head(left, columns=2)
    return figure


if __name__ == "__main__":
    script(loop_figure)
