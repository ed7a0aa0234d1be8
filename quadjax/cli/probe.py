"""Measure what the inputs and hidden layers of policies tell about the drones that they fly.

Flies the mean action on drones drawn from the config's randomization. A linear regression from one
observation, or from one hidden layer, to the thrust-to-weight ratio and other quantities of the
drone is fitted to half of the drones. The table has its R^2 on the other half.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import Parser, add_config, check_outputs, parse, seed, whole
from quadjax.core.interruptions import loading


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("probe", description=__doc__)
    add_config(parser)
    parser.add_argument(
        "--policy",
        action="append",
        required=True,
        metavar="FILE.npz",
        help="policy file; may be given several times",
    )
    parser.add_argument("--drones", type=whole(40, 10_000), default=500, help="number (500)")
    parser.add_argument("--seconds", type=whole(2, 60), default=8, help="of a flight (8)")
    parser.add_argument("--seed", type=seed, default=0, help="of the drones (0)")
    parser.add_argument("--json", metavar="FILE.json", help="write the numbers")
    parser.add_argument("--figure", metavar="FILE.png", help="draw R^2 and predictions")
    arguments = parse(parser, argv)
    check_outputs(arguments, json=(), figure=(".png", ".svg", ".pdf"))
    return arguments


def main(arguments: Sequence[str] | None = None) -> None:
    """Fly, fit, print the table and write the numbers and the figure."""
    options = _arguments(arguments)
    with loading():
        from rich.console import Console

        from quadjax.config.loading import load_config
        from quadjax.core.files import write_json
        from quadjax.core.plotting import save_figure
        from quadjax.core.provenance import file_record, provenance
        from quadjax.policy.file import Policy
        from quadjax.studies.probe import probe, probe_figure, probe_table

    config = load_config(options.config, options.overrides)
    policies = {
        label: (file, Policy.load(file, config))
        for label, file in zip(_labels(options.policy), options.policy, strict=True)
    }
    probes = []
    with Console(stderr=True).status("compiling and simulating") as status:
        for label, (_, policy) in policies.items():
            status.update(f"{label}: compiling and simulating")
            found = probe(policy, config, options.drones, options.seconds, options.seed, label)
            probes.append(found)
    print(probe_table(probes))
    print(f"R^2 of {probes[0].held_out} drones; fitted to {probes[0].fitted}")
    if options.json:
        numbers = {
            "probes": [each.to_json() | file_record(policies[each.label][0]) for each in probes],
            "drones": options.drones,
            "seconds": options.seconds,
            "provenance": provenance(config, seed=options.seed),
        }
        write_json(options.json, numbers)
    if options.figure:
        save_figure(probe_figure(probes), Path(options.figure))
    for file in (options.json, options.figure):
        if file:
            print(f"wrote {file}")


def _labels(files: Sequence[str]) -> list[str]:
    """Names of policies: those of their files or runs' folders; the files if two have one name."""
    paths = [Path(file) for file in files]
    names = [
        path.parent.name if path.stem == "policy" and path.parent.name else path.stem
        for path in paths
    ]
    return names if len(set(names)) == len(names) else list(files)
