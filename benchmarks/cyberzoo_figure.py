"""Posterior of ``benchmarks.calibrate``: a figure, and the rows of ``posterior.json``.

python -m benchmarks.cyberzoo_figure benchmarks/cyberzoo.npz docs/images/cyberzoo.png
"""

from pathlib import Path
from typing import Annotated

import numpy as np

from benchmarks import rows
from benchmarks.calibration_emulator import posterior
from benchmarks.calibration_likelihood import PRIORS
from benchmarks.settings import Tree
from quadjax.cli import script
from quadjax.cli.options import PICTURES, Output
from quadjax.core.plotting import INK, MUTED, SERIES, new_figure, save_figure, tidy

KEYS = list(PRIORS)
COMMAND = "python -m benchmarks.cyberzoo_figure benchmarks/cyberzoo.npz docs/images/cyberzoo.png"


def row(key: str, shares: np.ndarray) -> Tree:
    """Range of a number, median and 90% of its posterior ``shares`` (chains,) of the prior."""
    prior = PRIORS[key]
    values = [prior.low, prior.high, *prior.value(np.quantile(shares, (0.05, 0.5, 0.95)))]
    lowest, highest, low, middle, high = (f"{float(f'{x:.3g}'):g}" for x in values)
    return {
        "name": key,
        "command": COMMAND,
        "plant": ["cyberzoo"],
        "seeds": [0],
        "range": f"{lowest} to {highest}",
        "median": middle,
        "90%": f"{low} to {high}",
    }


def cyberzoo_figure(file: Path, output: Annotated[Path, Output(PICTURES)]) -> None:
    """Draw the posterior of each number in its prior and the correlations, and write the rows."""
    chains = posterior(file)
    rows.write("posterior", [row(key, chains[:, i]) for i, key in enumerate(KEYS)])
    drawn = new_figure(10.0, 4.6)
    left, right = drawn.subplots(1, 2)
    tidy(left)
    left.violinplot(chains, orientation="horizontal", showextrema=False, widths=0.9)
    left.plot(np.median(chains, axis=0), np.arange(len(KEYS)) + 1, "|", color=INK, ms=10)
    for i, prior in enumerate(PRIORS.values()):
        if 0.0 <= prior.off_share <= 1.0:
            left.plot(prior.off_share, i + 1, "x", color=SERIES[1], ms=5)
        left.text(-0.03, i + 1, f"{prior.low:g}", ha="right", va="center", color=MUTED, size=7)
        left.text(1.03, i + 1, f"{prior.high:g}", ha="left", va="center", color=MUTED, size=7)
    left.set_yticks(np.arange(len(KEYS)) + 1, KEYS)
    left.tick_params(axis="y", pad=32, length=0)
    left.spines["left"].set_visible(False)
    left.set_xticks([])
    left.set_title("posterior in the range of the prior; x: without the effect", color=INK, size=9)
    shown = right.imshow(np.corrcoef(chains.T), cmap="RdBu_r", vmin=-1, vmax=1)
    right.set_xticks(range(len(KEYS)), [key.split(".")[-1] for key in KEYS], rotation=90)
    right.set_yticks(range(len(KEYS)), [key.split(".")[-1] for key in KEYS])
    right.set_title("correlation", color=INK, size=9)
    drawn.colorbar(shown, ax=right, shrink=0.8)
    save_figure(drawn, output)


if __name__ == "__main__":
    script(cyberzoo_figure)
