"""Train on every track with every drone and compare the laps with the best known ones.

``python -m benchmarks.tracks e2e_race --output DIR`` trains, or flies --policy. The table has the
median of the laps after the first, mean action from hover, and the flights from random starts that
finish. The same command resumes. docs/design/tracks.md has results.
"""

from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter
from pydantic import Field as Bounded

import quadjax
from quadjax.cli import script
from quadjax.cli.options import LIST, ConfigName, Folder, Overrides, PolicyFile, Runs
from quadjax.core.errors import InputError
from quadjax.core.markdown import table
from quadjax.core.plotting import save_figure
from quadjax.core.sections import Field, Section, load_section
from quadjax.evaluation.training import train_once

Names = Annotated[tuple[str, ...], LIST, Parameter(metavar="NAME ...")]
TITLES = ("track", "drone", "lap", "best known", "gap", "finished", "top speed")


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


def words_of(track: str, vehicle: str) -> list[str]:
    """The overrides of a track, a name, a file or ``random_SEED``, and of a drone."""
    seed = track.removeprefix("random_")
    random = track.startswith("random_") and seed.isdigit()
    return [f"track.generate.seed={seed}" if random else f"track={track}", f"vehicle={vehicle}"]


def row_of(file: Path, config, names: tuple[str, str], best, runs: int, picture: Path) -> list[str]:
    """A line of the table; the lap is drawn to a file."""
    hover = quadjax.evaluate(file, config, runs=1, deterministic=True)
    starts = {"runs": runs, "deterministic": True, "start": "random", "seed": 1}
    finished = quadjax.evaluate(file, config, **starts).finished
    save_figure(hover.plot(), picture)
    times, lap, gap = hover.laps.whole_laps[0, 1:], None, "-"
    if np.isfinite(times).any():
        lap = float(np.median(times[np.isfinite(times)]))
    shown = f"{lap:.3f} s" if lap is not None else hover.laps.crashes[0] or "-"
    if best is not None and lap is not None:
        gap = f"{100 * (lap / best.seconds - 1):.1f}%"
    known = "-" if best is None else f"{best.seconds:.3f} s ({best.source})"
    speed = f"{hover.best.speed.max():.1f} m/s"
    return [*names, shown, known, gap, f"{finished} of {runs}", speed]


def tracks(
    config: ConfigName = "e2e_race",
    /,
    *overrides: Overrides,
    tracks: Names = ("square4", "figure8", "figure8_tudelft", "split_s"),
    drones: Names = ("bebop1", "5inch"),
    policy: PolicyFile | None = None,
    best: str = "best_known",
    runs: Runs = 100,
    output: Folder = Path("runs/tracks"),
) -> None:
    """Train, or fly POLICY; ``tracks`` are names, files or random_SEED, ``runs`` random starts."""
    laps, rows = read_best(best), [TITLES]
    pairs = [(track, vehicle) for vehicle in drones for track in tracks]
    words = {pair: [*words_of(*pair), *overrides] for pair in pairs}
    races = {pair: quadjax.load(config, words[pair]) for pair in pairs}
    for (track, vehicle), race in races.items():
        names, changes = (Path(track).stem, Path(vehicle).stem), words[track, vehicle]
        name = "_".join(names)
        file = policy or train_once(config, [*changes, f"name={name}"], output) / "policy.npz"
        picture = output / name / "lap.png"
        rows.append(row_of(file, race, names, laps.get(names), runs, picture))
    print(table(rows))


if __name__ == "__main__":
    script(tracks)
