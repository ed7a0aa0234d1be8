"""Evaluate a policy on drones that differ from their model, with and without disturbance estimate.

Each line of the table is a drone with a steady moment, less thrust, another residual, a damaged
rotor or a shifted mass. 'without' is a policy that was trained without disturbances; 'zeros' and
'estimated' are the policy that observes them, with zeros or with the onboard estimate as the
observation. The estimator has the model of the policy's training. key=value overrides change the
race with the unchanged drone.
"""

import argparse
from collections.abc import Sequence

from quadjax.cli.arguments import Parser, check_outputs, parse, runs, seed
from quadjax.core.interruptions import loading
from quadjax.core.resources import PRETRAINED


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("adaptation", description=__doc__)
    parser.add_argument("overrides", nargs="*", metavar="key=value", help="change the race")
    parser.add_argument(
        "--race", default="e2e", metavar="CONFIG", help="preset or YAML file (default: e2e)"
    )
    parser.add_argument(
        "--policy", default=str(PRETRAINED / "e2e_adaptive.npz"), metavar="FILE.npz"
    )
    parser.add_argument("--without", default=str(PRETRAINED / "e2e.npz"), metavar="FILE.npz")
    parser.add_argument("--runs", type=runs, default=100, help="flights of each kind (100)")
    parser.add_argument("--seed", type=seed, default=0)
    parser.add_argument("--json", metavar="FILE.json", help="write the numbers")
    options = parse(parser, argv)
    check_outputs(options, json=(".json",))
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly and tabulate."""
    options = _arguments(arguments)
    with loading():
        from rich.console import Console

        from quadjax.config.loading import load_config
        from quadjax.core.compilation_cache import enable_compilation_cache
        from quadjax.core.files import write_json
        from quadjax.core.provenance import file_record, provenance
        from quadjax.policy.file import Policy
        from quadjax.studies.adaptation import CONDITIONS, Study, format_rows, to_json
        from quadjax.training.progress import bar

    race = load_config(options.race, options.overrides)
    files = {"adaptive": options.policy, "without": options.without}
    adaptive, without = (Policy.load(file) for file in files.values())
    study = Study(race, adaptive, without, options.runs, options.seed)
    enable_compilation_cache()
    rows, console = [], Console(stderr=True)
    with bar(counted=True, console=console) as progress:
        task = progress.add_task("", total=len(CONDITIONS))
        for condition in CONDITIONS:
            progress.update(task, description=condition.label)
            rows.append(study.fly(condition))
            progress.advance(task)
    print(format_rows(rows))
    if options.json:
        policies = {name: file_record(file) for name, file in files.items()}
        origin = provenance(race, seed=options.seed) | {"policies": policies}
        write_json(options.json, {"results": [to_json(row) for row in rows], "provenance": origin})
        console.print(f"wrote {options.json}", highlight=False)
    return 0
