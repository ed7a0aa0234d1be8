"""Evaluate a policy on drones that differ from their model, with and without disturbance estimate.

'without' is a policy that was trained without disturbances; 'zeros' and 'estimated' are the policy
that observes them, with zeros or with the onboard estimate as the observation. The drones are those
of configs/conditions/damage.yaml; docs/design/adaptation.md has rows of the table.

    python -m benchmarks.adaptation [RUNS]
"""

import dataclasses

import quadjax
from quadjax.cli import options, script
from quadjax.evaluation.conditions import read_conditions
from quadjax.evaluation.table import policy_table

POLICIES = {  # by column: policy, and the disturbance that it observes
    "without": ("e2e_residual", "none"),
    "zeros": ("e2e_residual_disturbance", "none"),
    "estimated": ("e2e_residual_disturbance", "estimated"),
}


def rows(runs: int) -> list:
    """Mean and sampled flights of each column on every drone."""
    found, listed = [], read_conditions("damage")
    for column, (policy, source) in POLICIES.items():
        race = quadjax.load("e2e +residual", [f"observation.disturbance={source}"])
        for how, deterministic in (("mean", True), ("sampled", False)):
            options = {"deterministic": deterministic, "runs": runs, "conditions": listed}
            for row in quadjax.evaluate(policy, race, **options).rows:
                label = f"{column}, {how}"
                found.append(dataclasses.replace(row, policy=row.condition, condition=label))
    return found


def adaptation(runs: options.Runs = 100, /) -> None:
    """Print the table, with RUNS flights in each cell."""
    print(policy_table(rows(runs), "total").format("markdown"))


if __name__ == "__main__":
    script(adaptation)
