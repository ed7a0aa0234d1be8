"""Train on every track with every drone and compare the laps with the best known ones.

Each pair is trained by CONFIG in a folder of DIR, or flown with --policy. Prints a table of laps
(median of the laps after the first, mean action from hover) and of the flights from random starts
that finish. Writes tracks.md, tracks.json and a picture of each flight. After an interruption the
same command continues; finished training runs are not repeated.

    python -m benchmarks.tracks e2e_race --output runs/tracks
"""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import script
from quadjax.cli.options import Config, Folder, Overrides, PolicyFile, Runs
from quadjax.cli.output import steps
from quadjax.config.schema import Config as TrainingConfig
from quadjax.core.files import read_json, write_json, write_text
from quadjax.core.provenance import provenance
from quadjax.evaluation.seeds import train_once
from quadjax.studies.track_table import (
    RESULT,
    Case,
    Row,
    case_config,
    fly_case,
    lap_rows,
    read_best,
)

TRACKS = ("square4", "figure8", "figure8_tudelft", "split_s")
DRONES = ("bebop1", "5inch")
Names = Annotated[tuple[str, ...], Parameter(consume_multiple=True, metavar="NAME ...")]


def tracks(
    config: Config = "e2e_race",
    /,
    *overrides: Overrides,
    tracks: Names = TRACKS,
    drones: Names = DRONES,
    policy: PolicyFile | None = None,
    best: str = "best_known",
    runs: Runs = 100,
    output: Folder = Path("runs/tracks"),
) -> None:
    """Train, fly and tabulate.

    Args:
        tracks: Names, files, or random_SEED.
        drones: Names or files of vehicles.
        policy: Fly this policy, train nothing.
        best: Best known laps, with sources (YAML).
        runs: Flights from random starts.
        output: Write to DIR.
    """
    laps = read_best(best)
    cases = [Case(track, drone) for drone in drones for track in tracks]
    configs = {case: case_config(config, case, overrides) for case in cases}
    rows = []
    with steps() as report:
        for number, case in enumerate(cases, 1):
            report(f"{case.name}, {number} of {len(cases)}")
            words = [*case.overrides, *overrides, f"name={case.name}"]
            file = policy or train_once(config, words, output) / "policy.npz"
            rows.append(_row(case, configs[case], file, runs, output / case.name))
    text = lap_rows(rows, laps)
    print(text)
    write_text(output / "tracks.md", f"{text}\n")
    write_json(output / "tracks.json", {"laps": [row.to_json() for row in rows]})


def _row(case: Case, config: TrainingConfig, file: Path, runs: int, folder: Path) -> Row:
    """The flights of a case; a result of the same policy is read from its file."""
    result = folder / RESULT
    if result.exists() and result.stat().st_mtime >= file.stat().st_mtime:
        kept = read_json(result)
        origin = kept.pop("provenance", None) or {}
        present = provenance(config, file)
        same = all(origin.get(key) == present[key] for key in ("config", "policy"))
        if same and kept.get("runs") == runs:
            return Row(**kept)
    return fly_case(file, config, case, runs, folder)


if __name__ == "__main__":
    script(tracks)
