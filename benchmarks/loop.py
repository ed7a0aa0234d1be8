"""From flights of a first policy to a faster one, on drones drawn from a plant, for E2E and INDI.

For each drone (by its number in the plant): the first policies fly and are logged, constants,
inner loop and residual are fitted to the logs, each contender is trained on the fit with the same
learner, steps and reward, and its mean action flies on the drone. "INDI, tuned" has the thrust
limit with which it is the fastest with every flight finished, by other flights than are reported. A
result in the folder is not computed again, so the same command resumes. ``benchmarks.loop_tables``
prints the results.

    python -m benchmarks.loop --drones 0 1 2 --output runs/loop
"""

import itertools
from pathlib import Path
from typing import Annotated

from benchmarks.loop_drone import CONTENDERS, Drone
from benchmarks.loop_results import E2E, TUNED
from quadjax.cli import script
from quadjax.cli.options import LIST, Folder, PlantConfig, Seeds, whole
from quadjax.core.errors import InputError

Names = Annotated[tuple[str, ...], LIST]


def loop(
    *,
    plant: PlantConfig = "cyberzoo",
    drones: Seeds = tuple(range(10)),
    seeds: Seeds = (0,),
    contenders: Names = (E2E, TUNED),
    steps: Annotated[int, whole(1, 10**12)] = 7_000_000,
    output: Folder = Path("runs/loop"),
) -> None:
    """Fly, fit, train and fly again on drawn drones."""
    if unknown := set(contenders) - {TUNED, *CONTENDERS}:
        raise InputError(f"contenders: unknown {sorted(unknown)}, allowed: {[TUNED, *CONTENDERS]}")
    for seed, number, name in itertools.product(seeds, drones, contenders):
        drone = Drone(plant, number, output / str(number), steps)
        drone.contend(drone.tune(seed) if name == TUNED else name, seed)


if __name__ == "__main__":
    script(loop)
