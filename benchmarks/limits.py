"""Best known laps and lower bounds of the published tracks for several drones, as a table.

Each pair of a track and a drone is written to FOLDER as .json and .npz when it is done. A pair with
a .json file is not computed again, so that the script continues where it was interrupted. An .npz
file without one, such as a lap of an earlier version, is an initial guess.

    python -m benchmarks.limits FOLDER [--tracks square4 ..] [--drones a2rl ..] [--seconds 300]
"""

import argparse
from pathlib import Path
from typing import Any

from quadjax.config.loading import load_config
from quadjax.core.files import read_json, write_json
from quadjax.limits.result import best_known, save_unverified
from quadjax.limits.search import NotFoundError

TRACKS = ("square4", "figure8", "figure8_tudelft", "split_s", "grand_challenge")
DRONES = {  # by name: a preset and overrides
    "bebop_e2e": ("e2e_race",),
    "bebop_indi": ("indi +fastest",),
    "5inch": ("e2e +fastest", "vehicle=5inch"),
    "3inch": ("e2e +fastest", "vehicle=3inch"),
    "a2rl": ("e2e +fastest", "vehicle=a2rl"),
}


def compute(track: str, drone: str, path: Path, seconds: float, starts: int) -> dict[str, Any]:
    """The result of one pair, as of ``quadjax limit --json``; an ``error`` where there is none."""
    preset, *overrides = DRONES[drone]
    config, flight = load_config(preset, [f"track={track}", *overrides]), path.with_suffix(".npz")
    guesses = [flight] if flight.exists() else []
    try:
        result = best_known(config, guesses=guesses, starts=starts, seconds=seconds).bounded()
    except NotFoundError as error:
        if not guesses:
            save_unverified(flight, error)
        return {"error": str(error)}
    result.save(flight)
    return result.to_json()


def row(name: str, result: dict[str, Any]) -> str:
    """One line of the table."""
    if "error" in result:
        return f"| {name} | | | | {result['error']} |"
    low = result["lower_bound"]
    bound = "" if low is None else f"{low:.3f} s"
    times = f"{bound} | {result['best_known']:.4f} s | {result['seconds']:.0f} s"
    return f"| {name} | {times} | {result['guess']} |"


def main() -> None:
    """Compute what is missing and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tracks", nargs="+", default=TRACKS)
    parser.add_argument("--drones", nargs="+", default=tuple(DRONES), choices=tuple(DRONES))
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--starts", type=int, default=2)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    print("| track, drone | lower bound | best known | computing | from |\n|---|---|---|---|---|")
    for track in options.tracks:
        for drone in options.drones:
            path = options.folder / f"{track}_{drone}.json"
            if not path.exists():
                write_json(path, compute(track, drone, path, options.seconds, options.starts))
            print(row(f"{track}, {drone}", read_json(path)), flush=True)


if __name__ == "__main__":
    main()
