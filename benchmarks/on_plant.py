"""Shipped policies on ``cyberzoo``, five flights on each drone: the rows of ``plant.json``.

python -m benchmarks.on_plant e2e indi e2e_cyberzoo
"""

import numpy as np

import quadjax
from benchmarks import rows
from benchmarks.flown import flown
from quadjax.cli import script
from quadjax.core.errors import InputError
from quadjax.core.resources import PRETRAINED, policy_names

DRONES, FLIGHTS = 20, 5


def on_plant(*names: str) -> None:
    """Fly the policies of these names, all without one, and write their rows."""
    if unknown := set(names) - set(policy_names()):
        raise InputError(f"unknown {sorted(unknown)}, allowed: {', '.join(policy_names())}")
    for name in names or policy_names():
        policy = quadjax.Policy.load(PRETRAINED / f"{name}.npz")
        sampled, mean = flown(policy, ["cyberzoo"], FLIGHTS, DRONES)
        row = {
            "name": name,
            "command": f"python -m benchmarks.on_plant {name}",
            "policy": f"{name}.npz",
            "plant": ["cyberzoo"],
            "seeds": [policy.config["seed"]],
            "flights": sampled.runs,
            "noise": [round(float(np.exp(policy.log_std.mean())), 2)],
        }
        pairs = {"mean": mean, "sampled": sampled}
        times = {k: [round(x.total, 2) if x.finished else None] for k, x in pairs.items()}
        finished = {k: [x.finished] for k, x in pairs.items()}
        rows.write("plant", [row | {"total": times, "finished": finished}])


if __name__ == "__main__":
    script(on_plant)
