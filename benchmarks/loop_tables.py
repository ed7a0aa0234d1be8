"""Tables of ``benchmarks.loop``: E2E and tuned INDI, simulated and flown.

    python -m benchmarks.loop_tables runs/loop [--drones 1 2 3] [--seeds 0 1]

Times are of flights that finish; intervals are 95% intervals of the mean over drones, each of which
is the mean over its seeds. The lead of E2E is INDI's time less E2E's on the same drone.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.loop_results import (
    E2E,
    LAPS,
    LIMITS,
    TUNED,
    Read,
    fastest_limit,
    means,
    reader,
)
from quadjax.cli import script
from quadjax.cli.options import Seeds
from quadjax.core.markdown import table
from quadjax.evaluation.rows import interval


def cell(values: np.ndarray, sign: str = "") -> str:
    """Mean and interval of numbers of drones (drones,); "-" for none, the number itself for one."""
    middle, half = interval(values)
    mean = f"{middle:{sign}.2f}" if np.isfinite(middle) else "-"
    return f"{mean} ± {half:.2f}" if np.isfinite(half) else mean


def finished(laps: Sequence[Any]) -> str:
    """How many flights finish."""
    done = [np.isfinite(x).all(axis=1) for x in laps if x is not None]
    return f"{sum(map(np.sum, done))} of {sum(map(len, done))}"


def contenders(read: Read) -> str:
    """A row for each contender, of the drones that it has flown."""
    titles = "simulated, s", "flown, s", "finished", "slower in flight, s"
    rows: list[Sequence[str]] = [("contender", "drones", *titles)]
    for name in (E2E, TUNED, "E2E, residual", *(f"INDI, T {limit}" for limit in LIMITS)):
        flown = read(name, "flown")
        if count := sum(x is not None for x in flown):
            a, b = means(read(name, "simulated")).sum(axis=1), means(flown).sum(axis=1)
            a = np.where(np.isfinite(b), a, np.nan)  # of the same drones
            rows.append((name, f"{count}", cell(a), cell(b), finished(flown), cell(b - a, "+")))
    return table(rows)


def by_drone(read: Read, folder: Path, drones: Sequence[int], seeds: Sequence[int]) -> str:
    """E2E and tuned INDI on each drone; the limit of INDI in the training of each seed."""
    rows = [("drone", "INDI's limits", "INDI, s", "finished", "E2E, s", "finished", "lead, s")]
    flown = {name: read(name, "flown") for name in (TUNED, E2E)}
    indi, e2e = (means(laps).sum(axis=1) for laps in flown.values())
    for i, drone in enumerate(drones):
        names = (fastest_limit(folder / str(drone), seed) for seed in seeds)
        limits = ", ".join(name.removeprefix("INDI, T ") for name in names)
        counts = (finished(laps[i : i + 1]) for laps in flown.values())
        pairs = zip((f"{indi[i]:.2f}", f"{e2e[i]:.2f}"), counts, strict=True)
        numbers = (x for pair in pairs for x in pair)
        rows.append((f"{drone}", limits, *numbers, f"{(indi - e2e)[i]:.2f}"))
    totals = ((cell(times), finished(flown[name])) for name, times in ((TUNED, indi), (E2E, e2e)))
    rows.append(("mean", "", *(x for pair in totals for x in pair), cell(indi - e2e)))
    return table(rows)


def by_lap(read: Read) -> str:
    """Times and lead in each lap."""
    rows = [("lap", "E2E, simulated", "E2E, flown", "INDI, simulated", "INDI, flown", "lead, s")]
    columns = [means(read(name, key)) for name in (E2E, TUNED) for key in ("simulated", "flown")]
    for k in range(LAPS):
        times = (cell(x[:, k]) for x in columns)
        rows.append((f"{k + 1}", *times, cell((columns[3] - columns[1])[:, k])))
    return table(rows)


def responses(read: Read) -> str:
    """Mean thrust, and the errors of the models' responses to the commands (rms)."""
    rows = [("of the flights on the drones", "mean and interval over drones")]
    labels = {E2E: ["propeller speeds, rpm"], TUNED: ["p, rad/s", "q, rad/s", "r, rad/s"]}
    labels[TUNED] += ["thrust, m/s^2"]
    for name in (E2E, TUNED):
        there = [x for x in read(name, "errors") if x is not None]
        errors = np.array([x.mean(axis=0) for x in there])
        errors = errors.mean(axis=1, keepdims=True) if name == E2E else errors
        for label, values in zip(labels[name], errors.T, strict=True):
            rows.append((f"{name}: error of {label}", cell(values)))
        thrust = np.array([x.mean() for x in read(name, "thrust") if x is not None])
        rows.append((f"{name}: mean thrust, m/s^2", cell(thrust)))
    return table(rows)


def loop_tables(folder: Path, *, drones: Seeds = tuple(range(1, 11)), seeds: Seeds = (0,)) -> None:
    """Print the tables of contenders, drones, laps and responses."""
    read = reader(folder, drones, seeds)
    flights = contenders(read), by_drone(read, folder, drones, seeds)
    print("\n\n".join((*flights, by_lap(read), responses(read))))


if __name__ == "__main__":
    script(loop_tables)
