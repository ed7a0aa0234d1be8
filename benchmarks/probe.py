"""Measure what the inputs and hidden layers of policies tell about the drones that they fly.

Flies the mean action on drones drawn from the config's randomization. A linear regression from one
observation, or from one hidden layer, to the thrust-to-weight ratio and other quantities of the
drone is fitted to half of the drones. The table has its R^2 on the other half.

    python -m benchmarks.probe e2e_race_robust +history \
        --policy runs/e2e_race_robust_history/policy.npz
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import script
from quadjax.cli.options import Config, JsonFile, Overrides, Picture, PolicyFile, Seed, whole
from quadjax.cli.output import steps, write_record, wrote
from quadjax.config.loading import load_config
from quadjax.core.plotting import save_figure
from quadjax.core.provenance import file_record, provenance
from quadjax.policy.file import Policy
from quadjax.studies.probe import probe as probe_policy
from quadjax.studies.probe import probe_figure, probe_table


def probe(
    config: Config,
    /,
    *overrides: Overrides,
    policy: list[PolicyFile],
    drones: Annotated[int, Parameter(converter=whole(40, 10_000))] = 500,
    seconds: Annotated[int, Parameter(converter=whole(2, 60))] = 8,
    seed: Seed = 0,
    json: JsonFile = None,
    figure: Picture = None,
) -> None:
    """Measure what the inputs and hidden layers of policies tell about the drones.

    Args:
        policy: Policy file; may be repeated.
        drones: Number of drones.
        seconds: Of a flight.
        seed: Of the drones.
        json: Write the numbers.
        figure: Draw R^2 and predictions.
    """
    race = load_config(config, overrides)
    files = dict(zip(_labels(policy), policy, strict=True))
    probes = []
    with steps() as report:
        for label, file in files.items():
            report(f"{label}: compiling and simulating")
            network = Policy.load(file, race)
            probes.append(probe_policy(network, race, drones, seconds, seed, label))
    print(probe_table(probes))
    print(f"R^2 of {probes[0].held_out} drones; fitted to {probes[0].fitted}")
    rows = [row.to_json() | file_record(files[row.label]) for row in probes]
    record = {"probes": rows, "drones": drones, "seconds": seconds}
    write_record(json, record, provenance(race, seed=seed))
    if figure is not None:
        save_figure(probe_figure(probes), figure)
        wrote(figure)


def _labels(paths: Sequence[Path]) -> list[str]:
    """Names of policies: those of their files or runs' folders; the files if two have one name."""
    names = [
        path.parent.name if path.stem == "policy" and path.parent.name else path.stem
        for path in paths
    ]
    return names if len(set(names)) == len(names) else [str(path) for path in paths]


if __name__ == "__main__":
    script(probe)
