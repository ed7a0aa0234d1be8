"""Lap times and crashes of trained policies, compared with the best known laps.

``python -m benchmarks.tracks RUN ...`` flies the policies of runs with the mean action. It prints a
line for each track and drone, and one for all tracks of a drone: the median and the range of laps 2
to 6 from hover, and the crashes of 1,000 flights of 12 s from 1 m before a gate. With ``--preset``
it writes them as rows.
"""

import math
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

import quadjax
from benchmarks import rows as results
from benchmarks.best_laps import drone_of, read_best, row_of
from quadjax.cli import script
from quadjax.core.markdown import table

RUNS = 1000
TITLES = ("model", "track", "drone", "runs", "lap, s", "gap, %", "crashed, %")


def measure(run: quadjax.Run) -> tuple[float, float]:
    """The mean lap after the first, s, NaN where a lap is missing, and the crashed fraction."""
    same = {"config": run.config, "deterministic": True}
    hover = quadjax.evaluate(run.policy, **same, runs=1, laps=6).laps.whole_laps[0, 1:]
    starts = quadjax.evaluate(run.policy, **same, runs=RUNS, start="before_gate", seconds=12).row
    return float(hover.mean()), starts.crashed / starts.runs


def cell(values: np.ndarray, digits: int) -> str:
    """The median and the range of the numbers that are not NaN, and how many those are."""
    known = values[np.isfinite(values)]
    if not known.size:
        return "-"
    low, middle, high = (f"{x:.{digits}f}" for x in np.quantile(known, (0.0, 0.5, 1.0)))
    text = middle if len(values) == 1 else f"{middle} ({low}-{high})"
    return text if known.size == len(values) else f"{text}, {known.size} of {len(values)}"


def tracks(
    folders: Annotated[
        tuple[Path, ...], Parameter(name="RUN", help="Folders of runs of one preset.")
    ],
    /,
    *,
    best: str = "best_known",
    preset: str | None = None,
) -> None:
    """Fly the policies of runs.

    Args:
        folders: of runs of one preset.
        best: a file of best known laps, or its name.
        preset: that of the runs; with it their rows are written.
    """
    known = {(*drone_of(x.vehicle), x.track): x.seconds for x in read_best(best).values()}
    found: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    flown: dict[tuple[str, str, str], list[quadjax.Run]] = {}
    for folder in dict.fromkeys(folders):
        run = quadjax.Run.load(folder)
        key = (run.config.vehicle.model, run.config.vehicle.name, run.config.track.name)
        found.setdefault(key, []).append(measure(run))
        flown.setdefault(key, []).append(run)
        print(folder, file=sys.stderr, flush=True)
    if preset:
        results.write("tracks", [row_of(preset, flown[key], found[key]) for key in found])
    rows, of_drone = [TITLES], dict[tuple[str, str], list[np.ndarray]]()
    for (model, drone, track), numbers in found.items():
        laps, crashed = np.transpose(numbers)
        gaps = laps / known.get((model, drone, track), math.nan) - 1.0
        rows.append((model, track, drone, str(len(laps)), cell(laps, 3), *cells(gaps, crashed)))
        of_drone.setdefault((model, drone), []).append(np.stack([gaps, crashed]))
    for (model, drone), each in of_drone.items():
        gaps, crashed = np.concatenate(each, axis=1)
        rows.append((model, "all", drone, str(len(gaps)), "-", *cells(gaps, crashed)))
    print(table(rows))


def cells(gaps: np.ndarray, crashed: np.ndarray) -> tuple[str, str]:
    """Fractions in %."""
    return cell(100.0 * gaps, 1), cell(100.0 * crashed, 1)


if __name__ == "__main__":
    script(tracks)
