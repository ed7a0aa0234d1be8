"""Best known laps of ``configs/laps``, the drones that have them, and rows of laps of policies."""

import functools
import math
from pathlib import Path

from pydantic import Field as Bounded

import quadjax
from benchmarks.settings import Tree, check_run
from quadjax.core.errors import InputError
from quadjax.core.sections import Field, Section, load_section

DRONES = {"bebop1": "Bebop 1", "5inch": "5-inch", "3inch": "3-inch", "a2rl": "A2RL"}


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
        "command": f"quadjax train {preset} {' '.join(words)}, then "
        f"python -m benchmarks.tracks RUN --preset {preset}",
        "config": [preset, *words],
        "seeds": [run.config.seed for run in runs],
        "lap, s": [round(lap, 3) if math.isfinite(lap) else None for lap, _ in numbers],
        "crashed, %": [round(100.0 * crashed, 1) for _, crashed in numbers],
    }
    for run in runs:
        check_run(run, row)
    return row
