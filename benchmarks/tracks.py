"""Lap times and crashes of trained policies, compared with the best known laps.

``python -m benchmarks.tracks RUN ...`` flies the policies of runs with the mean action. It prints a
line for each track and drone, and one for all tracks of a drone: the median and the range of laps 2
to 6 from hover, and the crashes of 1,000 flights of 12 s from 1 m before a gate.
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
from quadjax.cli import script
from quadjax.core.errors import InputError
from quadjax.core.markdown import table
from quadjax.core.sections import Field, Section, load_section

RUNS = 1000
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


def tracks(
    runs: Annotated[tuple[Path, ...], Parameter(name="RUN", help="Folders of runs of one preset.")],
    /,
    *,
    best: str = "best_known",
) -> None:
    """Fly the policies of runs; ``best`` is a file of best known laps, or its name."""
    known = {(*drone_of(x.vehicle), x.track): x.seconds for x in read_best(best).values()}
    found: dict[tuple[str, str, str], list[tuple[float, float]]] = {}
    for folder in dict.fromkeys(runs):
        run = quadjax.Run.load(folder)
        vehicle, track = run.config.vehicle, run.config.track.name
        found.setdefault((vehicle.model, vehicle.name, track), []).append(measure(run))
        print(folder, file=sys.stderr, flush=True)
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
