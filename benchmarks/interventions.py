"""From INDI to E2E one step at a time, on ten drones of ``cyberzoo``: docs/design/protocol.md.

A row of ``benchmarks/results/interventions.json`` has the flights of one training; one that is
there is not measured again.

    python -m benchmarks.interventions --seeds 0 1 2 3 4
"""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import quadjax
from benchmarks import rows
from benchmarks.flown import flown, numbers, trained
from benchmarks.steps import ALL, MOTORS
from benchmarks.tournament import PLANT, Names
from quadjax.cli import script
from quadjax.cli.options import Folder, Seeds
from quadjax.core.errors import InputError

FILE, DRONES, FLIGHTS = "interventions", 10, 20


def interventions(
    *,
    steps: Names = tuple(ALL),
    seeds: Seeds = (0,),
    output: Folder = Path("runs/interventions"),
) -> None:
    """Train the steps, fly them on the drones 0 to 9, and write the rows.

    Args:
        steps: some of the steps.
        seeds: of the trainings.
        output: folder of the runs.
    """
    if unknown := set(steps) - set(ALL):
        raise InputError(f"steps: unknown {sorted(unknown)}, allowed: {'; '.join(ALL)}")
    done = {row["name"] for row in rows.read(FILE)}
    for seed, label in itertools.product(seeds, steps):
        step, name = ALL[label], f"{label}, seed {seed}"
        if name not in done:
            policy = policy_of(label, seed, output)
            race = quadjax.load(step.preset, step.training)
            laps = quadjax.evaluate(policy, race, runs=100, deterministic=False)
            if step.preset == MOTORS:
                policy = for_the_loop(policy, step.training)
            measured = numbers(*flown(policy, [PLANT, *step.plant], FLIGHTS, DRONES))
            rows.write(
                FILE, [row_of(label, seed) | {"simulated": round(laps.rows[0].total, 3)} | measured]
            )
            print(name, flush=True)


def policy_of(label: str, seed: int, output: Path) -> quadjax.Policy:
    """The policy of a step's training, which is named after the first step that has it."""
    step = ALL[label]
    same = next(name for name, each in ALL.items() if each[:2] == step[:2])
    folder = output / f"{same} {seed}".replace("/", "_").replace(" ", "_")
    return trained(step.preset, step.training, seed, folder)


def for_the_loop(policy: quadjax.Policy, words: Sequence[str]) -> quadjax.Policy:
    """A policy trained on the model ``inner_loop`` as one of ``rate``, which a plant can fly."""
    race = quadjax.load("indi_cyberzoo", words).model_dump(mode="json", by_alias=True)
    return dataclasses.replace(policy, vehicle="rate", config=race, residual=None)


def row_of(label: str, seed: int) -> dict[str, Any]:
    """Name, command and settings of a step's training."""
    step = ALL[label]
    return {
        "name": f"{label}, seed {seed}",
        "command": f"python -m benchmarks.interventions --steps '{label}' --seeds {seed}",
        "config": [step.preset, *step.training],
        "plant": [PLANT, *step.plant],
        "seeds": [seed],
        "step": label,
    }


if __name__ == "__main__":
    script(interventions)
