"""The authors' networks on the plant ``cyberzoo``, and the real flights: rows of ``cyberzoo.json``.

python -m benchmarks.cyberzoo_flights E2E.npz INDI.npz

Ten flights on each drone, with seeds that the calibration did not use.
"""

import numpy as np

import quadjax
from benchmarks import rows
from benchmarks.calibration_fleet import RACES, race_config
from benchmarks.settings import Tree
from quadjax.cli import options, script
from quadjax.plant.config import load_plant_config

PLANT, DRONES, FLIGHTS, LAPS, SEED = "cyberzoo", 20, 10, 6, 30_000


def row(name: str, laps: np.ndarray, **origin: object) -> Tree:
    """Mean laps and total, s, of those of the flights (flights, laps) that finish."""
    done = laps[np.isfinite(laps).all(axis=1)]
    first, *later = (f"{x:.2f}" for x in done.mean(axis=0))
    total = {"lap 1": first, "laps 2 to 6": ", ".join(later)}
    total["six laps"] = f"{done.sum(axis=1).mean():.2f}"
    total["completed"] = f"{len(done)} of {len(laps)}"
    return {"name": name, "label": name, **origin, **total}


def cyberzoo_flights(e2e: options.PolicyFile, indi: options.PolicyFile, /) -> None:
    """Fly both networks, sampled and with the mean action, and write their rows."""
    plant, made = load_plant_config(PLANT), []
    same = {"plant": plant, "runs": DRONES * FLIGHTS, "drones": DRONES, "laps": LAPS, "seed": SEED}
    for name, file in {"E2E": e2e, "INDI": indi}.items():
        race, origin = race_config(name, file), {"race": [RACES[name]], "seeds": [None]}
        policy = quadjax.Policy.load(file, race)
        here = origin | {"command": "python -m benchmarks.cyberzoo_flights E2E.npz INDI.npz"}
        for title, mean in (("sampled", False), ("mean action", True)):
            flown = quadjax.evaluate(policy, race, deterministic=mean, **same).rows[0]
            if not mean and (real := flown.published):
                source = origin | {"source": "arXiv 2311.16948, Table I"}
                made.append(row(f"{name}, real", real.laps.lap_times, **source))
            laps = np.asarray(flown.laps.lap_times)
            made.append(row(f"{name}, plant, {title}", laps, plant=[PLANT], **here))
            print(made[-1], flush=True)
    rows.write("cyberzoo", made)


if __name__ == "__main__":
    script(cyberzoo_flights)
