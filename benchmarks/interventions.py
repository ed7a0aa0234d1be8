"""From INDI to E2E one step at a time, on ten drones of ``cyberzoo``: docs/design/protocol.md.

A row of ``benchmarks/results/interventions.json`` has the flights of one training; one that is
there is not measured again.

    python -m benchmarks.interventions --seeds 0 1 2 3 4
"""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import quadjax
from benchmarks import rows
from benchmarks.flown import flown, numbers, trained
from benchmarks.tournament import PLANT, Names
from quadjax.cli import script
from quadjax.cli.options import Folder, Seeds
from quadjax.core.errors import InputError

FILE, DRONES, FLIGHTS = "interventions", 10, 20
FAST = tuple(f"vehicle.constants.{rate}_max={6 if rate != 'r' else 4}" for rate in "pqr")


class Step(NamedTuple):
    """What is trained, and what is changed in the training and on the plant."""

    preset: str
    training: tuple[str, ...] = ()
    plant: tuple[str, ...] = ()


def _thrust(limit: int) -> tuple[str, ...]:
    return (f"vehicle.constants.thrust_max={limit}",)


MOTORS = "benchmarks/indi_inner_loop.yaml"  # INDI, trained on the motors through its loop
QUICK = ("indi_simple.cutoff=20", "indi_simple.yaw_rate=4")  # of the inner loop
STEPS = {
    **{f"INDI, {limit} m/s^2": Step("indi_cyberzoo", _thrust(limit)) for limit in range(13, 21)},
    "INDI, 20 m/s^2, 6 rad/s": Step(
        "indi_cyberzoo", (*_thrust(20), *FAST), ("indi_simple.yaw_rate=4",)
    ),
    "INDI, 20 m/s^2, 6 rad/s, filters of 20 Hz": Step(
        "indi_cyberzoo", (*_thrust(20), *FAST), QUICK
    ),
    "INDI on the motors, 17 m/s^2": Step(MOTORS),
    "INDI on the motors, 20 m/s^2": Step(MOTORS, _thrust(20)),
    "INDI on the motors, 20 m/s^2, 6 rad/s": Step(
        MOTORS, (*_thrust(20), *FAST), ("indi_simple.yaw_rate=4",)
    ),
    **{
        f"E2E, {speed} rpm": Step("e2e_cyberzoo", (f"vehicle.constants.rpm_max={speed}",))
        for speed in (10300, 11000, 12000)
    },
    **{
        f"E2E, {what}": Step("e2e_cyberzoo", words)
        for what, words in {
            "estimate not observed": ("observation.disturbance=none",),
            "no delay": ("vehicle.delay=null",),
            "no battery": ("battery=null", "observation.highest_rpm=estimated"),
            "highest speed observed": ("observation.highest_rpm=estimated",),
            "lag drawn": ("randomization.constants={tau: 0.3}",),
        }.items()
    },
}


def interventions(
    *,
    steps: Names = tuple(STEPS),
    seeds: Seeds = (0,),
    output: Folder = Path("runs/interventions"),
) -> None:
    """Train the steps, fly them on the drones 0 to 9, and write the rows.

    Args:
        steps: some of the steps.
        seeds: of the trainings.
        output: folder of the runs.
    """
    if unknown := set(steps) - set(STEPS):
        raise InputError(f"steps: unknown {sorted(unknown)}, allowed: {'; '.join(STEPS)}")
    done = {row["name"] for row in rows.read(FILE)}
    for seed, label in itertools.product(seeds, steps):
        step, name = STEPS[label], f"{label}, seed {seed}"
        if name not in done:
            folder = output / f"{label} {seed}".replace("/", "_").replace(" ", "_")
            policy = trained(step.preset, step.training, seed, folder)
            simulated = quadjax.evaluate(policy, runs=100, deterministic=False).rows[0].total
            if step.preset == MOTORS:
                policy = for_the_loop(policy, step.training)
            measured = numbers(*flown(policy, [PLANT, *step.plant], FLIGHTS, DRONES))
            rows.write(FILE, [row_of(label, seed) | {"simulated": simulated} | measured])
            print(name, flush=True)


def for_the_loop(policy: quadjax.Policy, words: Sequence[str]) -> quadjax.Policy:
    """A policy trained on the model ``inner_loop`` as one of ``rate``, which a plant can fly."""
    race = quadjax.load("indi_cyberzoo", words).model_dump(mode="json", by_alias=True)
    return dataclasses.replace(policy, vehicle="rate", config=race, residual=None)


def row_of(label: str, seed: int) -> dict[str, Any]:
    """Name, command and settings of a step's training."""
    step = STEPS[label]
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
