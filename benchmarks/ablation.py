"""Ablation of residual, disturbance observation and randomization of E2E on the stand-in plant.

Each variant is a policy file of ``quadjax/pretrained/ablation`` (or of a folder that is named), its
training, and its disturbance observation. A policy that is missing is skipped, with the command
that trains it. docs/design/comparison.md has the numbers.

    python -m benchmarks.ablation [FOLDER]
"""

import sys
from pathlib import Path
from typing import NamedTuple

import quadjax
from quadjax.core.resources import PRETRAINED
from quadjax.evaluation.conditions import Condition, Conditions
from quadjax.evaluation.evaluate import joined

RESIDUAL, STEPS = "standin_residual.npz", "run.steps=12000000"
GROUPS = ("inertia", "thrust", "drag", "moment", "velocity_moment", "yaw", "lag")
WITH = ("e2e", STEPS, f"vehicle.residual={RESIDUAL}")
DISTURBED = ("e2e", "+disturbance", STEPS, f"vehicle.residual={RESIDUAL}")


class Variant(NamedTuple):
    """One line: what is varied, its value, the policy, and the config and words that train it."""

    group: str
    label: str
    policy: str
    training: tuple[str, ...]
    residual: bool = False  # whether the onboard model has that of the stand-in plant
    disturbance: str = "estimated"  # that it observes on the plant


def _randomized(percent: int) -> Variant:
    words = tuple(f"randomization.{group}={percent / 100}" for group in GROUPS)
    training = ("e2e", "+robust", STEPS, *words)
    return Variant("randomization", f"{percent}%", f"e2e_random_{percent}", training)


VARIANTS = (
    Variant("residual", "without", "e2e_nominal", ("e2e", STEPS)),
    Variant("residual", "with", "e2e_residual", WITH, True),
    *(
        Variant("disturbance", source, "e2e_ground_truth", DISTURBED, True, source)
        for source in ("ground_truth", "estimated", "none")
    ),
    *(_randomized(percent) for percent in (0, 10, 20, 30)),
)


def fly(variant: Variant, folder: Path, runs: int = 100):  # noqa: ANN201
    """The flights of one variant on the plant, as a row of the table."""
    condition = Condition(
        label=f"{variant.group}: {variant.label}", plant=(f"disturbance={variant.disturbance}",)
    )
    listed = Conditions(
        conditions=(condition,), plant="standin", deterministic=True, columns=("total", "ended")
    )
    race = quadjax.load("e2e +residual" if variant.residual else "e2e")
    file = folder / f"{variant.policy}.npz"
    return quadjax.evaluate(file, race, conditions=listed, runs=runs, name="E2E")


if __name__ == "__main__":
    policies = Path(sys.argv[1]) if sys.argv[1:] else PRETRAINED / "ablation"
    flown = []
    for variant in VARIANTS:
        if (policies / f"{variant.policy}.npz").is_file():
            flown.append(fly(variant, policies))
        else:
            words = f"{' '.join(variant.training)} seed=0 --name {variant.policy}"
            print(f"skipped, no policy in {policies}: quadjax train {words}")
    print(joined(flown).table())
