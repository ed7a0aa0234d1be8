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
from quadjax.config.race import race_of
from quadjax.core.files import read_json, write_json
from quadjax.limits.bound import lower_bound
from quadjax.limits.problem import Flight, make_problem
from quadjax.limits.report import read_guess, to_json, write_flight, write_unverified
from quadjax.limits.search import NotFoundError, Search

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
    config = load_config(preset, [f"track={track}", *overrides])
    fitted = config.vehicle.fitted_speed
    problem = make_problem(*race_of(config), Flight(fitted_speed=fitted))
    flight = path.with_suffix(".npz")
    guesses = {"earlier flight": read_guess(problem, str(flight))} if flight.exists() else {}
    try:
        best = Search(problem, seconds).run(guesses, starts)
    except NotFoundError as error:
        if not guesses:
            write_unverified(flight, error)
        return {"error": str(error)}
    top = best.check.top_speed
    bound = lower_bound(problem, max(top, min(1.2 * top, problem.speed_limit)), best.total)
    result = to_json(config, problem, best, bound, None, None)
    write_flight(flight, config, problem, best, result)
    return result


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
