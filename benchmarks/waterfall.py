"""Figure of the interventions: the score of each step, with 95% intervals.

python -m benchmarks.waterfall docs/images/waterfall.png
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.figure import Figure

from benchmarks import rows
from benchmarks.comparison_tables import FAILED_AFTER, flights
from quadjax.cli import script
from quadjax.cli.options import PICTURES, Output
from quadjax.core.plotting import INK, MUTED, SERIES, new_figure, save_figure, tidy
from quadjax.evaluation.leads import leads, totals

PATH = (  # from above
    "INDI, 16 m/s^2",
    "INDI, 17 m/s^2",
    "INDI, 18 m/s^2",
    "INDI, 20 m/s^2",
    "INDI, 17 m/s^2, no priorities",
    "INDI, 17 m/s^2, model effectiveness",
    "INDI, 20 m/s^2, no priorities",
    "INDI, 20 m/s^2, model effectiveness",
    "INDI on the motors, 17 m/s^2",
    "INDI on the motors, 20 m/s^2",
    "INDI on the motors, 20 m/s^2, 6 rad/s",
    "E2E, 12000 rpm",
    "E2E, 11000 rpm",
    "E2E, 10300 rpm",
)


def waterfall(file: Annotated[Path, Output(PICTURES)]) -> None:
    """Draw the steps that have rows."""
    save_figure(figure_of(rows.read("interventions")), file)


def figure_of(data: list[dict]) -> Figure:
    """Scores: large dots with 95% intervals; small ones are trainings."""
    found = [(step, [row for row in data if row["step"] == step]) for step in PATH]
    steps = [(step, flights(group)) for step, group in found if group]
    figure = new_figure(8.4, 0.8 + 0.42 * len(steps))
    axes = figure.subplots()
    tidy(axes)
    for index, (step, laps) in enumerate(steps):
        score = float(totals(laps, FAILED_AFTER).mean())
        color = SERIES[0] if step.startswith("E2E") else SERIES[1]
        each = totals(laps, FAILED_AFTER).mean(axis=(0, 2))
        axes.plot(each, np.full(len(each), index), ".", color=MUTED, ms=5)
        ahead = leads(laps, np.full_like(laps, score / laps.shape[-1]), FAILED_AFTER).score
        axes.plot([score - ahead.high, score - ahead.low], [index, index], color=INK, lw=1.2)
        axes.plot(score, index, "o", color=color, ms=6)
    axes.set_yticks(range(len(steps)), [step for step, _ in steps])
    axes.invert_yaxis()
    axes.set_xlabel("score (s): six laps; a flight that does not finish counts as 35 s", color=INK)
    return figure


if __name__ == "__main__":
    script(waterfall)
