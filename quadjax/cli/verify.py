"""``quadjax verify``."""

import dataclasses
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli.options import Flag, JsonFile, Race, whole
from quadjax.cli.output import write_record
from quadjax.core.errors import InputError, as_options
from quadjax.core.interruptions import loading
from quadjax.core.limits import MAX_RUNS


def verify(
    folder: Annotated[Path, Parameter(name="DIR")],
    /,
    *,
    vectors: Annotated[int, Parameter(converter=whole(100, 10**6))] = 5_000,
    runs: Annotated[int, Parameter(converter=whole(1, MAX_RUNS))] = 0,
    allow_unfinished: Flag = False,
    allow_other_race: Flag = False,
    mutations: Annotated[int, Parameter(converter=whole(1, 10**7))] = 2_000,
    race: Race = None,
    json: JsonFile = None,
) -> int:
    """Build and run an exported folder with the compilers of this machine.

    A C compiler of the host, or the one that pip installs, and an emulated
    Cortex-A9 (pip install 'quadjax[verify]') are enough. With
    arm-linux-gnueabi-gcc, arm-linux-gnueabihf-gcc, qemu-arm, frama-c and cppcheck
    on the path more is checked; a check without its tool is skipped, with the
    reason. A .qjp file in place of DIR is checked by itself. Exit status 0: no
    check failed.

    Example: quadjax verify out/ --json verification.json

    Args:
        folder: Folder of quadjax export, or FILE.qjp.
        vectors: Vectors for every build.
        runs: Runs of the closed loop.
        allow_unfinished: Accept a policy that was exported with --allow-unfinished.
        allow_other_race: Accept an export for a race that differs from the one in the
            policy file.
        mutations: Mutated .qjp files that are tried.
        race: Config of the race, if that of DIR names your own code (config.yaml of DIR).
        json: Write the table.
    """
    options = {
        "--runs": runs,
        "--allow-unfinished": allow_unfinished,
        "--allow-other-race": allow_other_race,
        "--race": race,
    }
    for option, value in options.items():
        if folder.suffix == ".qjp" and value:
            raise InputError(f"{option} has no effect on a .qjp file")
    with loading():
        from quadjax.core.provenance import provenance
        from quadjax.export.verify.file import verify_file
        from quadjax.export.verify.result import FAILED, Result, counts_text, row_text
        from quadjax.export.verify.run import CHECKS
        from quadjax.export.verify.run import verify as verify_folder

    def announce(name: str) -> None:
        if sys.stderr.isatty():
            print(f"\r\033[K{name} ..", end="", file=sys.stderr, flush=True)

    def report(result: Result) -> None:
        if sys.stderr.isatty():
            print("\r\033[K", end="", file=sys.stderr, flush=True)
        print(as_options(row_text(result, max(map(len, CHECKS)))), flush=True)

    if folder.suffix == ".qjp":
        policy, results = folder, verify_file(folder, vectors, mutations, announce, report)
    else:
        policy = folder / "policy.npz"
        results = verify_folder(
            folder,
            vectors,
            runs,
            announce,
            allow_unfinished=allow_unfinished,
            allow_other_race=allow_other_race,
            report=report,
            mutations=mutations,
            config=race,
        )
    print(f"\n{counts_text(results)}")
    rows = [dataclasses.asdict(result) for result in results]
    if json is not None:
        write_record(json, {"results": rows}, provenance(policy=policy))
    return int(any(result.verdict == FAILED for result in results))
