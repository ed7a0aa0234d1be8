"""Lap times and crashes of trained policies, compared with the best known laps.

``python -m benchmarks.tracks RUN ...`` flies the policies of runs with the mean action. It prints a
line for each track and drone, and one for all tracks of a drone: the median and the range of laps 2
to 6 from hover, and the crashes of 1,000 flights of 12 s from 1 m before a gate. With ``--preset``
it writes them as rows.
"""

import functools
import math
import sys
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter
from pydantic import Field as Bounded

import quadjax
from benchmarks import rows as results
from benchmarks.settings import Tree, check_run
from quadjax.cli import script
from quadjax.core.errors import InputError
from quadjax.core.markdown import table
from quadjax.core.sections import Field, Section, load_section

RUNS = 1000
DRONES = {"bebop1": "Bebop 1", "5inch": "5-inch", "3inch": "3-inch", "a2rl": "A2RL"}
TITLES = ("model", "track", "drone", "runs", "lap, s", "gap, %", "crashed, %")


class BestLap(Section):
    """One best known lap of ``configs/laps``."""

    track: str = Field(description="name of the track")
    vehicle: str = Field(description="name of the vehicle file")
    seconds: float = Bounded(gt=0, le=1e4, description="lap time, s")
    source: str = Field("", description="where the time comes from")


class BestLaps(Section):
    """A file of best known laps."""

    laps: tuple[BestLap, ...] = Field((), max_length=10_000, description="list of laps")


def read_best(path: Path | str) -> dict[tuple[str, str], BestLap]:
    """Best known laps by track and vehicle, of a file or a name in ``configs/laps``."""
    found: dict[tuple[str, str], BestLap] = {}
    for lap in load_section(BestLaps, path, "laps").laps:
        if found.setdefault((lap.track, lap.vehicle), lap) is not lap:
            raise InputError(f"{path}: two laps of {lap.track} with {lap.vehicle}, allowed: one")
    return found


@functools.cache
def drone_of(vehicle: str) -> tuple[str, str]:
    """The model and the name of a vehicle file, as ``e2e_race`` loads it."""
    section = quadjax.load("e2e_race", [f"vehicle={vehicle}"]).vehicle
    return section.model, section.name


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


def row_of(preset: str, runs: list[quadjax.Run], numbers: list[tuple[float, float]]) -> Tree:
    """The row of trainings of a preset on one track and drone.

    Raises:
        InputError: a drone that the table does not have, or runs with other settings.
    """
    config, files = runs[0].config, {drone_of(file)[1]: file for file in DRONES}
    vehicle, track = config.vehicle.name, config.track.name
    if vehicle not in files:
        raise InputError(f"{runs[0].folder}: drone {vehicle}, allowed: {', '.join(files)}")
    words = [f"track={track}", f"vehicle={files[vehicle]}"]
    row = {
        "name": f"{preset} {files[vehicle]} {track}",
        "command": f"quadjax train {preset} {' '.join(words)}, then python -m benchmarks.tracks",
        "config": [preset, *words],
        "seeds": [run.config.seed for run in runs],
        "lap, s": [round(lap, 3) if math.isfinite(lap) else None for lap, _ in numbers],
        "crashed, %": [round(100.0 * crashed, 1) for _, crashed in numbers],
    }
    for run in runs:
        check_run(run, row)
    return row


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
