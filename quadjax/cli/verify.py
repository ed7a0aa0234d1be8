"""Build and run an exported folder with the compilers of this machine and print the results.

A C compiler of the host, or the one that pip installs, and an emulated Cortex-A9 (pip install
'quadjax[verify]') are enough. With arm-linux-gnueabi-gcc, arm-linux-gnueabihf-gcc, qemu-arm,
frama-c and cppcheck on the path more is checked; a check without its tool is skipped, with the
reason. A .qjp file in place of DIR is checked by itself. Exit status 0: no check failed.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path

from quadjax.cli.arguments import Parser, check_outputs, count, parse, runs, whole
from quadjax.core.errors import InputError, as_options
from quadjax.core.interruptions import loading


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser("verify", description=__doc__)
    parser.add_argument(
        "folder", type=Path, metavar="DIR", help="folder of quadjax export, or FILE.qjp"
    )
    parser.add_argument(
        "--vectors", type=count, default=5_000, help="vectors for every build (default: 5000)"
    )
    parser.add_argument("--runs", type=runs, default=0, help="runs of the closed loop")
    parser.add_argument(
        "--allow-unfinished",
        action="store_true",
        help="accept a policy that was exported with --allow-unfinished",
    )
    parser.add_argument(
        "--allow-other-race",
        action="store_true",
        help="accept an export for a race that differs from the one in the policy file",
    )
    parser.add_argument(
        "--mutations",
        type=whole(1, 10**7),
        help="mutated .qjp files that are tried (default: 2000)",
    )
    parser.add_argument(
        "--race",
        metavar="CONFIG",
        help="config of the race, if that of DIR names your own code (config.yaml of DIR)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE.json", help="write the table")
    arguments = parse(parser, argv)
    for option in ("runs", "allow_unfinished", "allow_other_race", "race"):
        if arguments.folder.suffix == ".qjp" and getattr(arguments, option):
            raise InputError(f"--{option.replace('_', '-')} has no effect on a .qjp file")
    if arguments.vectors < 100:
        raise InputError(f"--vectors {arguments.vectors}: expected at least 100")
    check_outputs(arguments, json=(".json",))
    return arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """Verify, and print each row of the table when its check has run."""
    options = _arguments(arguments)
    with loading():
        from quadjax.core.files import write_json
        from quadjax.core.provenance import provenance
        from quadjax.export.verify.checks_qjp import MUTATIONS
        from quadjax.export.verify.file import verify_file
        from quadjax.export.verify.result import FAILED, Result, counts_text, row_text
        from quadjax.export.verify.run import CHECKS, verify

    mutations = options.mutations or MUTATIONS

    def announce(name: str) -> None:
        if sys.stderr.isatty():
            print(f"\r\033[K{name} ..", end="", file=sys.stderr, flush=True)

    def report(result: Result) -> None:
        if sys.stderr.isatty():
            print("\r\033[K", end="", file=sys.stderr, flush=True)
        print(as_options(row_text(result, max(map(len, CHECKS)))), flush=True)

    if options.folder.suffix == ".qjp":
        results = verify_file(options.folder, options.vectors, mutations, announce, report)
    else:
        results = verify(
            options.folder,
            options.vectors,
            options.runs,
            announce,
            allow_unfinished=options.allow_unfinished,
            allow_other_race=options.allow_other_race,
            report=report,
            mutations=mutations,
            config=options.race,
        )
    print(f"\n{counts_text(results)}")
    if options.json:
        rows = [dataclasses.asdict(result) for result in results]
        own = options.folder
        origin = provenance(policy=own if own.suffix == ".qjp" else own / "policy.npz")
        write_json(options.json, {"results": rows, "provenance": origin})
    return int(any(result.verdict == FAILED for result in results))
