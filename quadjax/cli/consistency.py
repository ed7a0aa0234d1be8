"""Check the consistency of the navigation filter: its errors against its standard deviations.

Simulates policies on the plant without unmodeled effects and delays, and computes how often each
component of the estimate is within three of its standard deviations and on how many flights the
filter diverges (an error above 0.5 m, 0.5 rad or 2 m/s, or not finite). Exit status 1 where a
component is within them less than 99% of the time or a flight diverges.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import (
    Parser,
    add_config,
    check_outputs,
    count,
    names_of,
    parse,
    runs,
    seed,
)
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("consistency", description=__doc__)
    add_config(parser, names_of("plant"))
    parser.add_argument("--race", default="e2e", metavar="CONFIG", help="preset or YAML file")
    parser.add_argument(
        "--policy", action="append", metavar="FILE.npz", help="(e2e.npz and indi.npz)"
    )
    parser.add_argument("--runs", type=runs, default=1000, help="of each policy (1000)")
    parser.add_argument("--seconds", type=count, default=20, help="of each flight (20)")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--json", metavar="FILE.json", help="write the numbers")
    arguments = parse(parser, argv)
    check_outputs(arguments, json=())
    return arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """Evaluate the filter on flights of some policies, print, and write if --json is given."""
    options = _arguments(arguments)
    with loading():
        from rich.console import Console

        from quadjax.config.loading import load_config
        from quadjax.core.files import write_json
        from quadjax.core.provenance import provenance
        from quadjax.plant.config import load_plant_config, without_effects
        from quadjax.studies.consistency import POLICIES, evaluate_filter, table

    plant = without_effects(load_plant_config(options.config, options.overrides))
    race, results = load_config(options.race), {}
    with Console(stderr=True).status("compiling") as status:
        for policy in map(Path, options.policy or [PRETRAINED / name for name in POLICIES]):

            def show(seconds: float, name: str = policy.name) -> None:
                status.update(f"{name}: {seconds:.0f} s simulated")

            results[policy.name] = evaluate_filter(
                race,
                plant,
                policy,
                options.runs,
                options.seconds,
                options.seed,
                show,
            )
            print(table(policy.name, results[policy.name]) + "\n")
    if options.json:
        numbers = {name: result.to_json() for name, result in results.items()}
        origin = provenance(plant, seed=options.seed)
        result = {"config": plant.model_dump(), "results": numbers, "provenance": origin}
        write_json(options.json, result)
        print(f"wrote {options.json}")
    return int(not all(result.passed for result in results.values()))
