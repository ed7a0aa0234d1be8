"""Ablation of residual, disturbance observation and randomization of E2E policies.

Each variant is a policy file, its training, and its disturbance observation on the stand-in plant.
"""

import dataclasses
from pathlib import Path

RESIDUAL = "standin_residual.npz"
STEPS = "run.steps=12000000"
_RANDOM = ("inertia", "thrust", "drag", "moment", "velocity_moment", "yaw", "lag")


@dataclasses.dataclass(frozen=True)
class Variant:
    """One line of the ablation.

    Attributes:
        group: what is varied.
        label: this line's value of it.
        policy: name of the policy, a file of the ablation's folder.
        training: config and ``key=value`` overrides that train it.
        residual: whether the onboard model has the stand-in plant's residual.
        disturbance: that it observes on the plant.
    """

    group: str
    label: str
    policy: str
    training: tuple[str, ...]
    residual: bool = False
    disturbance: str = "estimated"

    def command(self, runs: str = "runs") -> str:
        """The command that trains its policy into ``RUNS/POLICY/policy.npz``."""
        arguments = " ".join(self.training)
        return f"quadjax train {arguments} seed=0 --name {self.policy} --output {runs}"

    def path(self, folder: Path) -> Path:
        """Its policy file in the ablation's folder."""
        return folder / f"{self.policy}.npz"


def _randomized(percent: int) -> Variant:
    overrides = tuple(f"randomization.{group}={percent / 100}" for group in _RANDOM)
    training = ("e2e", "+robust", STEPS, *overrides)
    return Variant("randomization", f"{percent}%", f"e2e_random_{percent}", training)


_DISTURBED = ("e2e", "+disturbance", STEPS, f"vehicle.residual={RESIDUAL}")

VARIANTS = (
    Variant("residual", "without", "e2e_nominal", ("e2e", STEPS)),
    Variant(
        "residual",
        "with",
        "e2e_residual",
        ("e2e", STEPS, f"vehicle.residual={RESIDUAL}"),
        True,
    ),
    Variant("disturbance", "ground_truth", "e2e_ground_truth", _DISTURBED, True, "ground_truth"),
    Variant("disturbance", "estimated", "e2e_ground_truth", _DISTURBED, True, "estimated"),
    Variant("disturbance", "none", "e2e_ground_truth", _DISTURBED, True, "none"),
    *(_randomized(percent) for percent in (0, 10, 20, 30)),
)


def present(folder: Path) -> tuple[list[Variant], list[Variant]]:
    """The variants whose policy files are in a folder, and those that are not."""
    have = [variant for variant in VARIANTS if variant.path(folder).is_file()]
    return have, [variant for variant in VARIANTS if variant not in have]
