"""Ablation of residual, disturbance observation and randomization of E2E on the plant ``standin``.

Each variant is a policy of ``quadjax/pretrained/ablation``, or of a folder that is named, such as
the ``runs`` of trainings; its training; and its disturbance observation. A policy that is missing
is skipped, with the command that trains it. docs/design/comparison.md has the numbers.

    python -m benchmarks.ablation [FOLDER]
"""

from pathlib import Path
from typing import Annotated, NamedTuple

import quadjax
from quadjax.cli import options, script
from quadjax.core.errors import InputError
from quadjax.core.resources import POLICY_FILE, PRETRAINED
from quadjax.evaluation.conditions import Condition, Conditions
from quadjax.evaluation.result import joined

RESIDUAL, STEPS = "standin_residual.npz", "run.steps=12000000"
GROUPS = ("inertia", "thrust", "drag", "moment", "velocity_moment", "yaw", "lag")
LEARNER = (  # of every policy
    *("learner.optimizer=adam", "learner.learning_rate=0.004", "learner.num_envs=256"),
    *("learner.critic_epochs=4", "learner.critic_minibatches=8"),
)
WITH = ("e2e", STEPS, *LEARNER, f"vehicle.residual={RESIDUAL}")
DISTURBED = ("e2e", "+disturbance", STEPS, f"vehicle.residual={RESIDUAL}")


class Variant(NamedTuple):
    """One line: what is varied, its value, the policy, and the config and words that train it."""

    group: str
    label: str
    policy: str
    training: tuple[str, ...]
    residual: bool = False  # whether the onboard model has that of the plant
    disturbance: str = "estimated"  # that it observes on the plant


def _randomized(percent: int) -> Variant:
    words = tuple(f"randomization.{group}={percent / 100}" for group in GROUPS)
    training = ("e2e", "+robust", STEPS, *words)
    return Variant("randomization", f"{percent}%", f"e2e_random_{percent}", training)


VARIANTS = (
    Variant("residual", "without", "e2e_nominal", ("e2e", STEPS, *LEARNER)),
    Variant("residual", "with", "e2e_residual", WITH, True),
    *(
        Variant("disturbance", source, "e2e_ground_truth", DISTURBED, True, source)
        for source in ("ground_truth", "estimated", "none")
    ),
    *(_randomized(percent) for percent in (0, 10, 20, 30)),
)


def fly(variant: Variant, file: Path, runs: int):  # noqa: ANN201
    """The flights of one variant on the plant, as a row of the table."""
    condition = Condition(
        label=f"{variant.group}: {variant.label}", plant=(f"disturbance={variant.disturbance}",)
    )
    listed = Conditions(
        conditions=(condition,), plant="standin", deterministic=True, columns=("total", "ended")
    )
    race = quadjax.load("e2e +residual" if variant.residual else "e2e")
    return quadjax.evaluate(file, race, conditions=listed, runs=runs, name="E2E")


def ablation(
    folder: Annotated[Path, options.path("a folder")] = PRETRAINED / "ablation",
    /,
    *,
    runs: options.Runs = 100,
) -> None:
    """Fly the policies of a folder, which has their files or the folders of their runs."""
    flown = []
    for variant in VARIANTS:
        name = variant.policy
        files = [folder / f"{name}.npz", folder / name / POLICY_FILE]
        if file := next((file for file in files if file.is_file()), None):
            flown.append(fly(variant, file, runs))
        else:
            words = f"{' '.join(variant.training)} seed=0 --name {name}"
            print(f"skipped, no policy in {folder}: quadjax train {words}")
    if not flown:
        names = ", ".join(dict.fromkeys(variant.policy for variant in VARIANTS))
        raise InputError(f"{folder}: no policy, allowed: a folder with {names}")
    print(joined(flown).table())


if __name__ == "__main__":
    script(ablation)
