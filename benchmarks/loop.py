"""From flights of a first policy to a faster one, on drones drawn from a plant, for E2E and INDI.

For each drone (``constants.seed`` of the plant): the first policies fly and are logged, constants,
inner loop and residual are fitted to the logs (``quadjax fit standin_identified``), each
contender is trained on the fit, and its mean action flies on the drone. Both contenders have the
same logs, learner, steps and reward. A result that is in the folder is not computed again, so the
same command resumes; more drones, contenders or seeds add results.

    python -m benchmarks.loop --drones 1 2 3 --output runs/loop
    python -m benchmarks.loop --drones 1 2 3 --output runs/loop --table
"""

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

import quadjax
from quadjax.cli.fit import fit
from quadjax.cli.logs import logs
from quadjax.core.files import read_json, write_json
from quadjax.core.markdown import table
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation.rows import interval
from quadjax.plant.config import load_plant_config

FIRST = ("e2e_adaptive", "indi_shac")  # their flights are logged
STEPS = "run.steps=14000000"
FULL = "schedules.vehicle.residual_gain=null"  # from the first step: the first policies fly without
RATE = ("indi", STEPS)
CONTENDERS: dict[str, tuple[str, ...]] = {
    "E2E, residual": ("e2e", "+residual", STEPS, FULL),
    "E2E, residual and estimate": ("e2e", "+residual", "+disturbance", STEPS, FULL),
    "INDI": RATE,
    **{f"INDI, T {top}": (*RATE, f"vehicle.constants.thrust_max={top}") for top in (16, 18, 20)},
}
RUNS = {"laps": 6, "deterministic": True}


def identify(plant: str, drone: int, folder: Path) -> Path:
    """The folder of the fit to logs of the first policies."""
    if not (folder / "logs").exists():
        files = [PRETRAINED / f"{name}.npz" for name in FIRST]
        words = (plant, f"constants.seed={drone}")
        logs(*words, output=folder / "logs", policy=files, race="e2e +disturbance")
    if not (folder / "fit").exists():
        pattern = (folder / "logs" / "*.csv").resolve()
        words = ("logs.min_seconds=1", "logs.max_scale_error=0.5", "figures=false")
        fit("standin_identified", f"logs.files=[{pattern}]", *words, output=folder, name="fit")
    return folder / "fit"


def contend(name: str, seed: int, plant: str, drone: int, folder: Path) -> dict[str, Any]:
    """Totals of a contender's flights in its training race and on the drone."""
    path = folder / f"{name}, seed {seed}.json"
    if path.exists():
        return read_json(path)
    model = identify(plant, drone, folder)
    words = [*CONTENDERS[name], f"seed={seed}", f"vehicle.file={model / 'vehicle.yaml'}"]
    words += [f"vehicle.residual={model / 'residual.npz'}"] * ("+residual" in words)
    config = quadjax.load(words[0], words[1:])
    run = quadjax.train(config, folder / "runs" / path.stem, resume=True)
    still = config.replace(disturbance=type(config.disturbance)())
    drawn = load_plant_config(plant, [f"constants.seed={drone}"])
    results = {
        "simulated": quadjax.evaluate(run.policy, still, runs=10, **RUNS),
        "flown": quadjax.evaluate(run.policy, still, plant=drawn, runs=10, **RUNS),
    }
    totals = {key: [t if t > 0 else None for t in e.totals] for key, e in results.items()}
    write_json(path, json.loads(json.dumps(totals, default=float)))
    return read_json(path)


def _mean(totals: list[float | None]) -> float:
    done = [total for total in totals if total is not None]
    return float(np.mean(done)) if done else float("nan")


def loop_table(folder: Path, drones: list[int], names: list[str], seeds: list[int]) -> str:
    """A row for each contender: times of the flights that finish, with intervals over drones."""
    rows = [("contender", "simulated, s", "flown, s", "finished", "slower in flight, s")]
    for name in names:
        paths = [folder / str(d) / f"{name}, seed {s}.json" for s in seeds for d in drones]
        flights = [read_json(path) for path in paths if path.exists()]
        means = [[_mean(f["simulated"]), _mean(f["flown"])] for f in flights]
        simulated, flown = np.array(means).reshape(-1, 2).T
        ended = [t is not None for f in flights for t in f["flown"]]
        cells = ("{:.2f} ± {:.2f}".format(*interval(x)) for x in (simulated, flown))
        slower = "{:+.2f} ± {:.2f}".format(*interval(flown - simulated))
        rows.append((name, *cells, f"{sum(ended)} of {len(ended)}", slower))
    return table(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--plant", default="rough")
    parser.add_argument("--drones", type=int, nargs="+", default=list(range(1, 11)))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--contenders", nargs="+", default=list(CONTENDERS), choices=CONTENDERS)
    parser.add_argument("--output", type=Path, default=Path("runs/loop"))
    parser.add_argument("--table", action="store_true", help="of the results so far")
    options = parser.parse_args()
    for seed in [] if options.table else options.seeds:
        for drone in options.drones:
            for name in options.contenders:
                contend(name, seed, options.plant, drone, options.output / str(drone))
    print(loop_table(options.output, options.drones, options.contenders, options.seeds))
