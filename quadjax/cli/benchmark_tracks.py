"""Train on every track with every drone and compare the laps with the best known ones.

Each pair is trained by CONFIG in a folder of DIR, or flown with --policy. Prints a table of laps
(median of the laps after the first, mean action from hover), of the flights from random starts that
finish, and of the environment steps per second of each drone. Writes tracks.md, tracks.json and a
picture of each flight. After an interruption the same command continues; finished training runs are
not repeated.
"""

import argparse
import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from quadjax.cli.arguments import Parser, is_override, parse, runs
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.studies.track_table import Case, Row

CONFIG = "e2e_race"
TRACKS = ("square4", "figure8", "figure8_tudelft", "split_s")
DRONES = ("bebop1", "5inch")


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("benchmark tracks", description=__doc__)
    parser.add_argument("config", nargs="?", default=CONFIG, metavar="CONFIG", help="(e2e_race)")
    parser.add_argument(
        "overrides", nargs="*", default=[], metavar="key=value", help="change keys of the config"
    )
    parser.add_argument(
        "--tracks",
        nargs="+",
        default=list(TRACKS),
        metavar="TRACK",
        help=f"names, files, or random_SEED ({' '.join(TRACKS)})",
    )
    parser.add_argument(
        "--drones", nargs="+", default=list(DRONES), metavar="VEHICLE", help=f"({' '.join(DRONES)})"
    )
    parser.add_argument("--policy", metavar="FILE.npz", help="fly this policy, train nothing")
    parser.add_argument(
        "--best", default="best_known", metavar="FILE.yaml", help="best known laps, with sources"
    )
    parser.add_argument("--runs", type=runs, default=100, help="flights from random starts (100)")
    parser.add_argument("--no-speed", action="store_true", help="do not measure steps per second")
    parser.add_argument(
        "--output", type=Path, default=Path("runs/tracks"), metavar="DIR", help="(runs/tracks)"
    )
    options = parse(parser, argv)
    if is_override(options.config):
        options.overrides, options.config = [options.config, *options.overrides], CONFIG
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, fly and tabulate."""
    options = _arguments(arguments)
    with loading():
        from quadjax.core.files import write_json, write_text
        from quadjax.studies.track_table import Case, case_config, lap_rows, read_best, speed_rows
        from quadjax.training.progress import bar

    best = read_best(options.best)
    cases = [Case(track, drone) for drone in options.drones for track in options.tracks]
    configs = {case: case_config(options.config, case, options.overrides) for case in cases}
    rows: list[Row] = []
    with bar(counted=True) as progress:
        task = progress.add_task("tracks", total=len(cases))
        for case in cases:
            progress.update(task, description=case.name)
            rows.append(_row(case, configs[case], options))
            progress.advance(task)
    speeds = {} if options.no_speed else _speeds(options)
    text = lap_rows(rows, best)
    if speeds:
        text += f"\n\n{speed_rows(speeds, options.drones[0])}"
    print(text)
    write_text(options.output / "tracks.md", f"{text}\n")
    table = {"laps": [row.to_json() for row in rows], "steps_per_second": speeds}
    write_json(options.output / "tracks.json", table)
    return 0


def _row(case: "Case", config: "Config", options: argparse.Namespace) -> "Row":
    """Train if needed, and fly; a result of the same policy is read from its file."""
    from quadjax.core.files import read_json
    from quadjax.core.provenance import provenance
    from quadjax.studies.track_table import RESULT, Row, fly_case

    folder = options.output / case.name
    file = Path(options.policy) if options.policy else _train(case, options)
    result = folder / RESULT
    if result.exists() and result.stat().st_mtime >= file.stat().st_mtime:
        kept = read_json(result)
        origin = kept.pop("provenance", None) or {}
        own = provenance(config, file)
        same = all(origin.get(key) == own[key] for key in ("config", "policy"))
        if same and kept.get("runs") == options.runs:
            return Row(**kept)
    return fly_case(file, config, case, options.runs, folder)


def _train(case: "Case", options: argparse.Namespace) -> Path:
    """The policy of a case; a finished training is not repeated."""
    from quadjax.config.loading import load_config
    from quadjax.training.folder import check_same
    from quadjax.training.result import is_finished

    own = [*case.overrides, *options.overrides, f"name={case.name}"]
    folder = options.output / case.name
    check_same(load_config(options.config, own), folder)
    if not is_finished(folder):
        command = [sys.executable, "-m", "quadjax", "train", options.config, *own, "--resume"]
        status = subprocess.run([*command, "--output", str(options.output)], check=False).returncode
        if status == INTERRUPTED:
            raise KeyboardInterrupt
        if status:
            raise InputError(f"training {case.name} failed with status {status}")
    return folder / "policy.npz"


def _speeds(options: argparse.Namespace) -> dict[str, float]:
    """Environment steps per second of each drone, measured once for an output folder."""
    from quadjax.cli.benchmark import OBSERVED, Job, measure
    from quadjax.core.files import write_json

    path = options.output / "speeds.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    for drone in options.drones:
        if drone not in found:
            job = Job("observed", "e2e_shac", OBSERVED, 3, vehicle=drone)
            found[drone] = measure(job)["steps_per_second"]
            write_json(path, found)
    return {drone: found[drone] for drone in options.drones}
