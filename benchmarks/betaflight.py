"""Policies through Betaflight's firmware: docs/design/betaflight.md.

A row of ``benchmarks/results/betaflight.json`` has the flights of one training; one that is there
is not measured again. The gains are those of ``benchmarks.betaflight_response``.

    python -m benchmarks.betaflight --seeds 0 1 2 3 4
"""

import itertools
import math
import shlex
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import quadjax
from benchmarks import betaflight_response, rows
from benchmarks.betaflight_contenders import CONTENDERS, DRONES, config
from benchmarks.flown import LAPS, trained
from benchmarks.tournament import Names
from quadjax.cli import script
from quadjax.cli.options import Folder, Seeds
from quadjax.core.errors import InputError
from quadjax.fitting.config import load_fit_config
from quadjax.fitting.fit import fit
from quadjax.race.laps import Laps
from quadjax.sil.run import Setting, fly_all

FILE = "betaflight"


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
    for given, allowed in ((drones, DRONES), (contenders, tuple(CONTENDERS))):
        if unknown := set(given) - set(allowed):
            raise InputError(f"unknown {sorted(unknown)}, allowed: {'; '.join(allowed)}")
    done = {row["name"] for row in rows.read(FILE)}
    for seed, drone, contender in itertools.product(seeds, drones, contenders):
        if (name := f"{drone}, {contender}, seed {seed}") in done:
            continue
        words = f"--drones {drone} --contenders {shlex.quote(contender)} --seeds {seed}"
        preset, *overrides = config(contender, drone)
        folder = output / name.replace(", ", "_").replace("seed ", "").replace(" ", "_").lower()
        policy = trained(preset, overrides, seed, folder)
        row = {
            "name": name,
            "command": f"python -m benchmarks.betaflight {words}",
            "config": [preset, *overrides],
            "seeds": [seed],
            "drone": drone,
            "contender": contender,
            "flown": {"own model": in_own_model(policy)},
        }
        for gains in ("default", "tuned") if contender != "E2E" else ():
            row["flown"][gains] = through_betaflight(folder, drone, settings_of(drone, gains))
        rows.write(FILE, [row])
        print(name, {key: flight["laps"] for key, flight in row["flown"].items()}, flush=True)


def settings_of(drone: str, gains: str) -> Sequence[str]:
    """The settings of measured gains."""
    response = rows.read(betaflight_response.FILE)
    return next(row["settings"] for row in response if row["name"] == f"{drone}, {gains}")


def in_own_model(policy: quadjax.Policy) -> dict[str, Any]:
    """One flight of a policy's mean action in the simulator of its training."""
    return numbers(quadjax.evaluate(policy, runs=1, laps=LAPS, deterministic=True).rows[0].laps)


def through_betaflight(folder: Path, drone: str, settings: Sequence[str]) -> dict[str, Any]:
    """One flight through Betaflight with settings; if it finishes, also the lags of a fit to it."""
    setting = Setting(folder / "policy.npz", None, LAPS, betaflight=tuple(settings))
    flown = fly_all(setting, threading.Event())
    motors = flown.races[0].flight["command"]
    at_limit = ((motors <= 0.0) | (motors >= 1.0)).any(axis=1).mean()
    made = numbers(flown.laps) | {"saturated": round(float(at_limit), 3)}
    if not made["end"]:
        flown.write(folder)
        words = [f"logs.files={folder / 'log_0.csv'}", f"vehicle={drone}_betaflight.yaml"]
        rate = fit(load_fit_config("betaflight", words)).vehicle.models["rate"]
        made |= {key: round(rate[key], 4) for key in ("tau_rate", "tau_thrust")}
    return made


def numbers(laps: Laps) -> dict[str, Any]:
    """The laps of one flight, s, null where they are not flown, and how it ended early."""
    times = [float(time) for time in laps.lap_times[0]]
    return {
        "laps": [round(time, 3) if math.isfinite(time) else None for time in times],
        "end": laps.crashes[0],
    }


if __name__ == "__main__":
    script(betaflight)
