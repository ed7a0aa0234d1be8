"""Convert a policy file to fixed-point C.

DIR gets the network, the observation, the estimators and a Paparazzi module as C, with self-tests,
and a report of proofs and measurements. ``quadjax verify DIR`` builds and runs it.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import Parser, add_ranges, names_of, parse
from quadjax.core.interruptions import loading
from quadjax.export.targets import DEFAULT_TARGET, TARGETS


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("export", description=__doc__)
    parser.add_argument("policy", type=Path, metavar="POLICY.npz", help="policy file")
    parser.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="folder for the C"
    )
    parser.add_argument(
        "--target",
        choices=TARGETS,
        default=DEFAULT_TARGET,
        help="processor and autopilot (default: cortex-a9, with a Paparazzi module)",
    )
    parser.add_argument("--name", help="prefix of every C symbol (default: the file's name)")
    add_ranges(
        parser, "declare +-R for an input instead of the default, a power of two: position=16"
    )
    parser.add_argument("--track", help=names_of("tracks"))
    parser.add_argument(
        "--race",
        "--config",
        dest="config",
        metavar="CONFIG",
        help="training config of the policy's race (default: the one in the policy file, or the "
        "preset that it names)",
    )
    parser.add_argument("--sample-rate", type=float, help="of the estimators, Hz (default: 512)")
    parser.add_argument(
        "--cutoff", type=float, help="of the disturbance estimator's low-pass, Hz (default: 8)"
    )
    parser.add_argument(
        "--allow-unfinished",
        action="store_true",
        help="export a policy of which less than 90%% of the simulated flights finish",
    )
    parser.add_argument(
        "--allow-other-race",
        action="store_true",
        help="export for a race that differs from the one in the policy file",
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="write to a folder that no export made, and replace its files of the same names",
    )
    return parse(parser, argv)


ALLOWANCES = ("--allow-unfinished", "--allow-other-race")  # options that quadjax verify needs too


def verification(options: argparse.Namespace) -> str:
    """The command that verifies the export of these options."""
    used = [x for x in ALLOWANCES if getattr(options, x.removeprefix("--").replace("-", "_"))]
    return " ".join(["quadjax verify", str(options.output), *used])


def main(arguments: Sequence[str] | None = None) -> None:
    """Convert, write, and print the report."""
    options = _arguments(arguments)
    with loading():
        from quadjax.export.convert import export_c
        from quadjax.export.ranges import parse_overrides

    export = export_c(
        options.policy,
        options.output,
        options.config,
        parse_overrides(options.ranges),
        options.name,
        track=options.track,
        sample_rate=options.sample_rate,
        cutoff=options.cutoff,
        allow_unfinished=options.allow_unfinished,
        allow_other_race=options.allow_other_race,
        target=options.target,
        overwrite=options.overwrite,
    )
    print(export.text)
    print(f"Written to {options.output}. Next: {verification(options)}")
