"""Shipped policies on ``cyberzoo``, five flights on each drone: the rows of ``plant.json``.

python -m benchmarks.on_plant e2e indi e2e_cyberzoo
"""

from typing import Annotated

import numpy as np

import quadjax
from benchmarks import rows
from benchmarks.flown import flown
from quadjax.cli import script
from quadjax.cli.options import LIST
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED, policy_names

PLANT, DRONES, FLIGHTS = "cyberzoo", 20, 5


def on_plant(*names: str, changes: Annotated[tuple[str, ...], LIST] = ()) -> None:
    """Fly the named policies, or all without a name, and write their rows.

    Args:
        names: of shipped policies.
        changes: of the plant, such as 'battery.charge=[0.2, 0.2]'.
    """
    if unknown := set(names) - set(policy_names()):
        raise InputError(f"unknown {sorted(unknown)}, allowed: {', '.join(policy_names())}")
    for name in names or policy_names():
        policy = quadjax.Policy.load(PRETRAINED / f"{name}.npz")
        sampled, mean = flown(policy, [PLANT, *changes], FLIGHTS, DRONES)
        label = " ".join([name, *changes])
        given = "".join(f" --changes '{change}'" for change in changes)
        row = {
            "name": label,
            "command": f"python -m benchmarks.on_plant {name}{given}",
            "policy": f"{name}.npz",
            "plant": [PLANT, *changes],
            "seeds": [policy.config["seed"]],
            "flights": sampled.runs,
            "noise": [round(float(np.exp(policy.log_std.mean())), 2)],
        }
        pairs = {"mean": mean, "sampled": sampled}
        times = {k: [round(x.total, 2) if x.finished else None] for k, x in pairs.items()}
        finished = {k: [x.finished] for k, x in pairs.items()}
        rows.write("plant", [row | {"total": times, "finished": finished}])
        print(label, times, finished, flush=True)


if __name__ == "__main__":
    script(on_plant)
