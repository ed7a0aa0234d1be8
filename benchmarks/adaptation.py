"""E2E with and without the disturbance estimate, on drones with constant damage.

The drones are those of configs/conditions/damage.yaml, in the simulator. *zeros* is the policy that
observes the estimate, with zeros in its place; *not observed* is one that was trained without it.
Five trainings of each; a row of ``benchmarks/results/adaptation.json`` has those of a drone.

    python -m benchmarks.adaptation --seeds 0 1 2 3 4
"""

from pathlib import Path

import quadjax
from benchmarks import rows
from benchmarks.interventions import policy_of
from quadjax.cli import script
from quadjax.cli.options import Folder, Seeds
from quadjax.evaluation.conditions import read_conditions

WITH, BLIND = "E2E, 12000 rpm", "E2E, estimate not observed"
COLUMNS = {  # step of the interventions, and the disturbance that its policies observe
    "estimated": (WITH, "estimated"),
    "zeros": (WITH, "none"),
    "not observed": (BLIND, "none"),
}
RUNS, RACE = 100, "e2e_cyberzoo"


def adaptation(
    *, seeds: Seeds = (0, 1, 2, 3, 4), output: Folder = Path("runs/interventions")
) -> None:
    """Train the policies, unless a folder has their runs, fly them, and write the rows."""
    listed, found = read_conditions("damage"), {}
    for column, (step, source) in COLUMNS.items():
        race = quadjax.load(RACE, [f"observation.disturbance={source}"])
        for seed in seeds:
            policy = policy_of(step, seed, output)
            options = {"conditions": listed, "deterministic": False, "runs": RUNS}
            for row in quadjax.evaluate(policy, race, **options).rows:
                of_drone = found.setdefault(row.condition, {})
                total = round(row.total, 2) if row.finished else None
                of_drone.setdefault(column, []).append([row.finished, total])
        print(column, flush=True)
    rows.write("adaptation", [row_of(drone, seeds, cells) for drone, cells in found.items()])


def row_of(drone: str, seeds: Seeds, cells: dict[str, list]) -> dict:
    """The row of a drone: flights that finish and their mean time, of each training."""
    numbers = " ".join(map(str, seeds))
    return {
        "name": drone,
        "command": f"python -m benchmarks.adaptation --seeds {numbers}",
        "config": [RACE],
        "seeds": list(seeds),
        "flights": RUNS,
        "finished": {column: [count for count, _ in of] for column, of in cells.items()},
        "total": {column: [total for _, total in of] for column, of in cells.items()},
    }


if __name__ == "__main__":
    script(adaptation)
