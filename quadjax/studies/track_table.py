"""A table of tracks and drones: the laps of a policy on each against the best known ones."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field as Bounded

from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
from quadjax.core.files import write_json
from quadjax.core.markdown import table
from quadjax.core.plotting import save_figure
from quadjax.core.provenance import provenance
from quadjax.core.sections import Field, Section, load_section
from quadjax.evaluation.evaluation import evaluate
from quadjax.policy.file import Policy

RANDOM = "random_"  # and a seed: the random track of that seed with the default settings
RESULT, PICTURE = "result.json", "lap.png"


class BestLap(Section):
    """One best known lap."""

    track: str = Field(description="name of the track")
    vehicle: str = Field(description="name of the vehicle file")
    seconds: float = Bounded(gt=0, le=1e4, description="lap time, s")
    source: str = Field("", description="where the time comes from")


class BestLaps(Section):
    """A file of best known laps."""

    laps: tuple[BestLap, ...] = Field((), max_length=10_000, description="list of laps")


def read_best(path: Path | str) -> dict[tuple[str, str], BestLap]:
    """Best known laps by track and vehicle, of a file or a name in ``configs/laps``.

    Raises:
        InputError: an unreadable file, an unknown key, or two laps of one track and vehicle.
    """
    found: dict[tuple[str, str], BestLap] = {}
    for lap in load_section(BestLaps, path, "laps").laps:
        if (lap.track, lap.vehicle) in found:
            raise InputError(f"{path}: two laps of {lap.track} with {lap.vehicle}, allowed: one")
        found[lap.track, lap.vehicle] = lap
    return found


@dataclasses.dataclass(frozen=True)
class Case:
    """One track with one drone."""

    track: str
    vehicle: str

    @property
    def name(self) -> str:
        """The name of its folder."""
        return f"{Path(self.track).stem}_{Path(self.vehicle).stem}"

    @property
    def overrides(self) -> list[str]:
        """The track and the drone as overrides of a config."""
        seed = self.track.removeprefix(RANDOM)
        if self.track.startswith(RANDOM) and seed.isdigit():
            track = f"track.generate.seed={int(seed)}"
        else:
            track = f"track={self.track}"
        return [track, f"vehicle={self.vehicle}"]


@dataclasses.dataclass(frozen=True)
class Row:
    """The laps of one policy on one track.

    Attributes:
        track, vehicle: names.
        lap: median of the laps after the first, mean action from hover, s; None if none.
        finished: flights from random starts, mean action, that complete every lap.
        runs: number of those flights.
        speed: highest speed of the flight from hover, m/s.
        crash: why the flight from hover ended early; empty if it did not.
    """

    track: str
    vehicle: str
    lap: float | None
    finished: int
    runs: int
    speed: float
    crash: str

    def to_json(self) -> dict[str, Any]:
        """The row as JSON takes it."""
        return dataclasses.asdict(self)


def fly_case(file: Path, config: Config, case: Case, runs: int, folder: Path) -> Row:
    """Fly a policy on a track, draw its lap, and write both to a folder."""
    policy = Policy.load(file)
    hover = evaluate(policy, config, runs=1, deterministic=True)
    starts = evaluate(policy, config, runs=runs, deterministic=True, start="random", seed=1)
    laps = hover.laps.whole_laps[0, 1:]
    flown = laps[np.isfinite(laps)]
    row = Row(
        track=Path(case.track).stem,
        vehicle=Path(case.vehicle).stem,
        lap=round(float(np.median(flown)), 4) if flown.size else None,
        finished=starts.finished,
        runs=runs,
        speed=round(float(hover.best.speed.max()), 2),
        crash=hover.laps.crashes[0],
    )
    save_figure(hover.plot(), folder / PICTURE)
    write_json(folder / RESULT, row.to_json() | {"provenance": provenance(config, file)})
    return row


def case_config(config: Path | str, case: Case, overrides: Sequence[str] = ()) -> Config:
    """The config of a preset on a track with a drone."""
    return load_config(config, [*case.overrides, *overrides])


def lap_rows(rows: Sequence[Row], best: dict[tuple[str, str], BestLap]) -> str:
    """A Markdown table: laps against the best known ones, with the sources below it."""
    titles = ["track", "drone", "lap", "best known", "gap", "finished", "top speed"]
    cells, sources = [titles], []
    for row in rows:
        known = best.get((row.track, row.vehicle))
        lap = f"{row.lap:.3f} s" if row.lap is not None else row.crash or "-"
        shown, gap = "-", "-"
        if known is not None:
            if known.source not in sources:
                sources.append(known.source)
            shown = f"{known.seconds:.3f} s ({sources.index(known.source) + 1})"
            if row.lap is not None:
                gap = f"{100 * (row.lap / known.seconds - 1):.1f}%"
        done = f"{row.finished} of {row.runs}"
        cells.append([row.track, row.vehicle, lap, shown, gap, done, f"{row.speed:.1f} m/s"])
    notes = [f"({index}) {source}" for index, source in enumerate(sources, start=1)]
    return "\n\n".join([table(cells), *notes])
