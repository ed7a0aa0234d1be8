"""From flights of a first policy to a faster one, on drones drawn from a plant, for E2E and INDI.

For each drone (``constants.seed`` of the plant): the first policies fly and are logged, constants,
inner loop and residual are fitted to the logs (``quadjax fit standin_identified``), each contender
is trained on the fit with the same learner, steps and reward, and its mean action flies on the
drone. A result that is in the folder is not computed again, so the same command resumes.

    python -m benchmarks.loop --drones 1 2 3 --output runs/loop
"""

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from cyclopts import Parameter

import quadjax
from quadjax.cli import script
from quadjax.cli.fit import fit
from quadjax.cli.logs import logs
from quadjax.core.errors import InputError
from quadjax.core.files import read_json, write_json
from quadjax.core.markdown import table
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation.rows import interval
from quadjax.plant.config import load_plant_config

FIRST = ("e2e_adaptive", "indi_shac")  # their flights are logged
STEPS = "run.steps=14000000"
FULL = "schedules.vehicle.residual_gain=null"  # from the first step: the first policies fly without
CONTENDERS: dict[str, tuple[str, ...]] = {
    "E2E, residual": ("e2e", "+residual", STEPS, FULL),
    "E2E, residual and estimate": ("e2e", "+residual", "+disturbance", STEPS, FULL),
    "INDI": ("indi", STEPS),
    **{f"INDI, T {t}": ("indi", STEPS, f"vehicle.constants.thrust_max={t}") for t in (16, 18, 20)},
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


def contend(name: str, seed: int, plant: str, drone: int, folder: Path) -> None:
    """Write the totals of a contender's flights in its training race and on the drone."""
    path = folder / f"{name}, seed {seed}.json"
    if path.exists():
        return
    model = identify(plant, drone, folder)
    words = [*CONTENDERS[name], f"seed={seed}", f"vehicle.file={model / 'vehicle.yaml'}"]
    words += [f"vehicle.residual={model / 'residual.npz'}"] * ("+residual" in words)
    config = quadjax.load(words[0], words[1:])
    run = quadjax.train(config, folder / "runs" / path.stem, resume=True)
    still = config.replace(disturbance=type(config.disturbance)())
    drone_config = load_plant_config(plant, [f"constants.seed={drone}"])
    results = {
        "simulated": quadjax.evaluate(run.policy, still, runs=10, **RUNS),
        "flown": quadjax.evaluate(run.policy, still, plant=drone_config, runs=10, **RUNS),
    }
    totals = {key: [float(t) if t > 0 else None for t in e.totals] for key, e in results.items()}
    write_json(path, totals)


def loop_table(
    folder: Path, drones: Sequence[int], names: Sequence[str], seeds: Sequence[int]
) -> str:
    """A row for each contender: times of the flights that finish, with intervals over drones."""
    rows = [("contender", "simulated, s", "flown, s", "finished", "slower in flight, s")]
    for name in names:
        files = [f"{d}/{name}, seed {s}.json" for s in seeds for d in drones]
        flights = [read_json(folder / file) for file in files]
        totals = [[np.array(f[key], float) for key in ("simulated", "flown")] for f in flights]
        means = [[np.nanmean(t) if np.isfinite(t).any() else np.nan for t in r] for r in totals]
        simulated, flown = np.array(means).reshape(-1, 2).T
        ended = [t is not None for f in flights for t in f["flown"]]
        cells = ("{:.2f} ± {:.2f}".format(*interval(x)) for x in (simulated, flown))
        slower = "{:+.2f} ± {:.2f}".format(*interval(flown - simulated))
        rows.append((name, *cells, f"{sum(ended)} of {len(ended)}", slower))
    return table(rows)


def loop(
    *,
    plant: str = "rough",
    drones: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = tuple(range(1, 11)),
    seeds: Annotated[tuple[int, ...], Parameter(consume_multiple=True)] = (0,),
    contenders: Annotated[tuple[str, ...], Parameter(consume_multiple=True)] = tuple(CONTENDERS),
    output: Path = Path("runs/loop"),
) -> None:
    """Fly, fit, train and fly again on drawn drones, and print the table of the results."""
    if unknown := set(contenders) - set(CONTENDERS):
        raise InputError(f"contenders: unknown {sorted(unknown)}, allowed: {list(CONTENDERS)}")
    for seed, drone, name in itertools.product(seeds, drones, contenders):
        contend(name, seed, plant, drone, output / str(drone))
    print(loop_table(output, drones, contenders, seeds))


if __name__ == "__main__":
    script(loop)
