"""Policies through Betaflight's firmware: docs/design/betaflight.md.

A row of ``benchmarks/results/betaflight.json`` has the flights of one training. A row that is there
is not measured again, so the same command resumes. Seeds come first. The gains are those of
``benchmarks.betaflight_response``.

    python -m benchmarks.betaflight --seeds 0 1 2 3 4
"""

import itertools
import math
import shlex
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from benchmarks import betaflight_response, rows
from benchmarks.betaflight_contenders import CONTENDERS, DRONES, config
from benchmarks.flown import LAPS, trained
from quadjax.cli import script
from quadjax.cli.options import LIST, Folder, Seeds
from quadjax.fitting.config import load_fit_config
from quadjax.fitting.fit import fit
from quadjax.sil.run import Setting, fly_all

FILE = "betaflight"
Names = Annotated[tuple[str, ...], LIST]


def betaflight(
    *,
    drones: Names = DRONES,
    contenders: Names = tuple(CONTENDERS),
    seeds: Seeds = (0,),
    output: Folder = Path("runs/betaflight"),
) -> None:
    """Train the contenders, fly them, and write the rows.

    Args:
        drones: vehicles.
        contenders: of ``benchmarks.betaflight_contenders``.
        seeds: of the trainings.
        output: folder of runs and flights.
    """
    done = {row["name"] for row in rows.read(FILE)}
    for seed, drone, contender in itertools.product(seeds, drones, contenders):
        name = f"{drone}, {contender}, seed {seed}"
        if name in done:
            continue
        words = f"--drones {drone} --contenders {shlex.quote(contender)} --seeds {seed}"
        preset, *overrides = config(contender, drone)
        folder = output / name.replace(", ", "_").replace("seed ", "").replace(" ", "_").lower()
        trained(preset, overrides, seed, folder)
        row = {
            "name": name,
            "command": f"python -m benchmarks.betaflight {words}",
            "config": [preset, *overrides],
            "seeds": [seed],
            "drone": drone,
            "contender": contender,
            "flown": {"own model": flown(folder, drone, None)},
        }
        for gains in ("default", "tuned") if contender != "E2E" else ():
            row["flown"][gains] = flown(folder, drone, settings_of(drone, gains))
        rows.write(FILE, [row])
        print(name, {key: flight["laps"] for key, flight in row["flown"].items()}, flush=True)


def settings_of(drone: str, gains: str) -> Sequence[str]:
    """The settings of measured gains."""
    response = rows.read(betaflight_response.FILE)
    return next(row["settings"] for row in response if row["name"] == f"{drone}, {gains}")


def flown(folder: Path, drone: str, settings: Sequence[str] | None) -> dict[str, Any]:
    """One flight of a policy, through Betaflight with settings or, without, in its own model."""
    gains = None if settings is None else tuple(settings)
    result = fly_all(
        Setting(folder / "policy.npz", None, LAPS, betaflight=gains), threading.Event()
    )
    made: dict[str, Any] = {
        "laps": [
            round(x, 3) if math.isfinite(x) else None for x in map(float, result.laps.lap_times[0])
        ],
        "end": result.laps.crashes[0],
    }
    if gains is None:
        return made
    motors = result.races[0].flight["command"]
    made["saturated"] = round(float(((motors <= 0.0) | (motors >= 1.0)).any(axis=1).mean()), 3)
    if not made["end"]:
        result.write(folder)
        words = [f"logs.files={folder / 'log_0.csv'}", f"vehicle={drone}_betaflight.yaml"]
        rate = fit(load_fit_config("betaflight", words)).vehicle.models["rate"]
        made |= {key: round(rate[key], 4) for key in ("tau_rate", "tau_thrust")}
    return made


if __name__ == "__main__":
    script(betaflight)
