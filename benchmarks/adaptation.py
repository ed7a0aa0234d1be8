"""Evaluate a policy on drones that differ from their model, with and without disturbance estimate.

Each line of the table is a drone with a steady moment, less thrust, another residual, a damaged
rotor or a shifted mass. 'without' is a policy that was trained without disturbances; 'zeros' and
'estimated' are the policy that observes them, with zeros or with the onboard estimate as the
observation. The table is in docs/design/adaptation.md.

    python -m benchmarks.adaptation --runs 100
"""

from quadjax.cli import script
from quadjax.cli.options import JsonFile, Overrides, PolicyFile, Runs, Seed
from quadjax.cli.output import steps, write_record
from quadjax.config.loading import load_config
from quadjax.core.compilation_cache import enable_compilation_cache
from quadjax.core.provenance import file_record, provenance
from quadjax.core.resources import PRETRAINED
from quadjax.policy.file import Policy
from quadjax.studies.adaptation import CONDITIONS, Study, format_rows, to_json


def adaptation(
    *overrides: Overrides,
    race: str = "e2e +residual",
    policy: PolicyFile = PRETRAINED / "e2e_adaptive.npz",
    without: PolicyFile = PRETRAINED / "e2e.npz",
    runs: Runs = 100,
    seed: Seed = 0,
    json: JsonFile = None,
) -> None:
    """Evaluate a policy on drones that differ from their model.

    Args:
        race: Preset or YAML file, with the unchanged drone.
        policy: Policy that observes disturbances.
        without: Policy that was trained without disturbances.
        runs: Flights of each kind.
        seed: Of the flights.
        json: Write the numbers.
    """
    config = load_config(race, overrides)
    study = Study(config, Policy.load(policy), Policy.load(without), runs, seed)
    enable_compilation_cache()
    rows = []
    with steps() as report:
        for condition in CONDITIONS:
            report(condition.label)
            rows.append(study.fly(condition))
    print(format_rows(rows))
    files = {"adaptive": file_record(policy), "without": file_record(without)}
    origin = provenance(config, seed=seed) | {"policies": files}
    write_record(json, {"results": [to_json(row) for row in rows]}, origin)


if __name__ == "__main__":
    script(adaptation)
