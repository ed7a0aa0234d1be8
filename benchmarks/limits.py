"""Best known laps of the published tracks for several drones, as a table.

Each pair of a track and a drone is written to FOLDER as .json and .npz when it is done. A pair with
a .json file is not computed again, so that the script continues where it was interrupted. An .npz
file without one, such as of ``quadjax limit --npz``, is an initial guess.

    python -m benchmarks.limits FOLDER [--tracks square4 ..] [--drones a2rl ..] [--seconds 300]
"""

from pathlib import Path
from typing import Annotated, Any

from quadjax.cli import options, script
from quadjax.config.loading import load_config
from quadjax.config.schema import Config
from quadjax.core.errors import InputError
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


def config_of(track: str, drone: str) -> Config:
    """The race of a drone on a track."""
    preset, *overrides = DRONES[drone]
    return load_config(preset, [f"track={track}", *overrides])


def compute(config: Config, path: Path, seconds: float, starts: int) -> dict[str, Any]:
    """The result of one pair, as of ``quadjax limit --json``; an ``error`` where there is none."""
    flight = path.with_suffix(".npz")
    guesses = [flight] if flight.exists() else []
    try:
        result = best_known(config, guesses=guesses, starts=starts, seconds=seconds)
    except NotFoundError as error:
        if not guesses:
            save_unverified(flight, error, config)
        return {"error": str(error)}
    result.save(flight)
    return result.to_json()


def row(name: str, result: dict[str, Any]) -> str:
    """One line of the table."""
    if "error" in result:
        return f"| {name} | | | {result['error']} |"
    times = f"{result['best_known']:.4f} s | {result['seconds']:.0f} s"
    return f"| {name} | {times} | {result['guess']} |"


def limits(
    folder: options.Folder,
    /,
    *,
    tracks: Annotated[tuple[str, ...], options.LIST] = TRACKS,
    drones: Annotated[tuple[str, ...], options.LIST] = tuple(DRONES),
    seconds: options.Count = 300,
    starts: options.Count = 2,
) -> None:
    """Compute what is missing and print the table."""
    if unknown := [drone for drone in drones if drone not in DRONES]:
        raise InputError(f"--drones {unknown[0]}: allowed: {', '.join(DRONES)}")
    pairs = [(track, drone) for track in tracks for drone in drones]
    configs = {pair: config_of(*pair) for pair in pairs}
    folder.mkdir(parents=True, exist_ok=True)
    print("| track, drone | best known | computing | from |\n|---|---|---|---|")
    for pair, config in configs.items():
        path = folder / f"{'_'.join(pair)}.json"
        if not path.exists():
            write_json(path, compute(config, path, seconds, starts))
        print(row(", ".join(pair), read_json(path)), flush=True)


if __name__ == "__main__":
    script(limits)
