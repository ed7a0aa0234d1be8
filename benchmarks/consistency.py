"""Check the consistency of the navigation filter: its errors against its standard deviations.

Simulates policies on the plant without unmodeled effects and delays, and computes how often each
component of the estimate is within three of its standard deviations and on how many flights the
filter diverges (an error above 0.5 m, 0.5 rad or 2 m/s, or not finite). Exit status 1 where a
component is within them less than 99% of the time or a flight diverges.

    python -m benchmarks.consistency standin
"""

from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import script
from quadjax.cli.options import Count, JsonFile, Overrides, PolicyFile, Runs, Seed, config_of
from quadjax.cli.output import steps, write_record
from quadjax.config.loading import load_config
from quadjax.core.provenance import provenance
from quadjax.core.resources import PRETRAINED
from quadjax.plant.config import load_plant_config, without_effects
from quadjax.studies.consistency import POLICIES, evaluate_filter, table


def consistency(
    config: Annotated[str, Parameter(name="CONFIG"), config_of("plant")],
    /,
    *overrides: Overrides,
    race: str = "e2e +residual",
    policy: list[PolicyFile] | None = None,
    runs: Runs = 1000,
    seconds: Count = 20,
    seed: Seed = 0,
    json: JsonFile = None,
) -> int:
    """Check the consistency of the navigation filter.

    Args:
        race: Preset or YAML file.
        policy: Policy file; may be repeated (default: e2e and indi).
        runs: Of each policy.
        seconds: Of each flight.
        seed: Of the sensors.
        json: Write the numbers.
    """
    plant = without_effects(load_plant_config(config, overrides))
    flown, results = load_config(race), {}
    with steps() as report:
        for file in policy or [PRETRAINED / name for name in POLICIES]:

            def show(simulated: float, name: str = file.name) -> None:
                report(f"{name}: {simulated:.0f} s simulated")

            result = evaluate_filter(flown, plant, file, runs, seconds, seed, show)
            results[file.name] = result
            print(table(file.name, result) + "\n")
    numbers = {name: result.to_json() for name, result in results.items()}
    record = {"config": plant.model_dump(), "results": numbers}
    write_record(json, record, provenance(plant, seed=seed))
    return int(not all(result.passed for result in results.values()))


if __name__ == "__main__":
    script(consistency)
