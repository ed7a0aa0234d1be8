"""What ``benchmarks.loop`` leaves in its folder, read for ``loop_tables`` and ``loop_figure``."""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from quadjax.core.errors import InputError
from quadjax.core.files import read_json
from quadjax.flights.flight import Flight

E2E, TUNED = "E2E, residual and estimate", "INDI, tuned"
LIMITS = range(10, 21)  # m/s^2, of INDI's thrust
CHOSEN = "chosen"  # the flights by which INDI's limit is chosen
GRAVITY = 9.81  # m/s^2
LAPS = 6
Read = Callable[[str, str], list[Any]]  # contender, key -> value of each drone, None for none


def mean_thrust(flights: Sequence[Flight]) -> float:
    """Mean specific force of flights along body -z, m/s^2."""
    means = []
    for flight in flights:
        force = np.gradient(flight["velocity"], flight.time, axis=0) - [0.0, 0.0, GRAVITY]
        means.append(-flight.rotation.apply(force, inverse=True)[:, 2].mean())
    return float(np.mean(means))


def fastest_limit(folder: Path, seed: int, limits: Iterable[int] = LIMITS) -> str:
    """The INDI contender of a seed that finishes the most flights, the fastest of several."""

    def merit(name: str) -> tuple[int, float]:
        flown = read_json(folder / f"{name}, seed {seed}.json")[CHOSEN]
        return flown["finished"], -float(np.mean([total or 0.0 for total in flown["totals"]]))

    names = [f"INDI, T {limit}" for limit in limits]
    flown = [name for name in names if (folder / f"{name}, seed {seed}.json").exists()]
    if not flown:
        raise InputError(f"{folder}: no flights of INDI; run benchmarks.loop with INDI, tuned")
    return max(flown, key=merit)


def reader(folder: Path, drones: Sequence[int], seeds: Sequence[int]) -> Read:
    """Reads a contender's laps (flights, laps), s, or other numbers (seeds, k), of each drone."""

    def read(name: str, key: str) -> list[Any]:
        result: list[Any] = []
        for at in (folder / str(drone) for drone in drones):
            labels = {seed: fastest_limit(at, seed) if name == TUNED else name for seed in seeds}
            files = [at / f"{label}, seed {seed}.json" for seed, label in labels.items()]
            records = [read_json(file)[key] for file in files if file.exists()]
            laps = [r["laps"] if isinstance(r, dict) else [r] for r in records]
            result.append(np.concatenate(np.array(laps, float)) if records else None)
        return result

    return read


def means(laps: Sequence[Any]) -> np.ndarray:
    """Mean laps of the flights that finish (drones, laps), s; NaN where none does."""
    done = [[] if x is None else x[np.isfinite(x).all(axis=1)] for x in laps]
    return np.stack([np.mean(x, axis=0) if len(x) else np.full(LAPS, np.nan) for x in done])


def logged_thrust(folder: Path) -> float:
    """Mean specific thrust that the logs of INDI measure, m/s^2."""
    logs = [np.genfromtxt(file, delimiter=",", names=True) for file in folder.glob("indi*.csv")]
    return -float(np.mean([log["ekf_U3"].mean() for log in logs]))
