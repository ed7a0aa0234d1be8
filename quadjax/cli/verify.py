"""``quadjax verify``."""

import dataclasses
import sys
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import wrote
from quadjax.core.errors import quadjax_command
from quadjax.core.files import check_file, write_json
from quadjax.core.interruptions import loading
from quadjax.export.names import POLICY_FILE, report_of


def verify(
    folder: Annotated[opt.Export, Parameter(name="DIR")],
    /,
    *,
    vectors: Annotated[int, opt.whole(100, 10**6)] = 5_000,
    runs: opt.Runs = 0,
    allow_unfinished: opt.AllowUnfinished = False,
    allow_other_race: opt.AllowOtherRace = False,
    race: opt.Race = None,
    json: opt.JsonFile = None,
) -> int:
    """Build and run an exported folder with the compiler of this machine.

    A C compiler of this machine, or the one that pip installs (pip install
    'quadjax[verify]'), is enough. A check that does not apply is skipped, with the
    reason. A .qjp file in place of DIR is checked by itself. Exit status 0: no check
    failed.

    Example: quadjax verify out/ --json verification.json

    Args:
        folder: Folder of quadjax export, or FILE.qjp.
        vectors: Vectors on which C and NumPy must agree.
        runs: Runs of the closed loop.
        race: Config of the race, if that of DIR names your own code (config.yaml of DIR).
        json: Write the table.
    """
    is_file = folder.suffix == ".qjp"
    if is_file:
        allowed = {"allow_unfinished": allow_unfinished, "allow_other_race": allow_other_race}
        opt.refuse("on a .qjp file", runs=runs or None, race=race, **allowed)
        check_file(folder)
    else:
        report_of(folder)
    with loading():
        from quadjax.core.provenance import provenance
        from quadjax.export.verify.checks import CHECKS
        from quadjax.export.verify.result import FAILED, Result, counts_text, row_text
        from quadjax.export.verify.run import verify as verify_folder

    def report(result: Result) -> None:
        _status("")
        print(row_text(result, max(map(len, CHECKS))), flush=True)

    policy = folder if is_file else folder / POLICY_FILE
    results = verify_folder(
        folder,
        vectors,
        runs,
        lambda name: _status(f"{name} .."),
        allow_unfinished=allow_unfinished,
        allow_other_race=allow_other_race,
        report=report,
        config=race,
    )
    print(f"\n{counts_text(results)}")
    rows = [dataclasses.asdict(result) for result in results]
    if json is not None:
        write_json(json, {"results": rows, "provenance": provenance(policy=policy)})
    wrote(json)
    failed = any(result.verdict == FAILED for result in results)
    if not is_file and not failed:
        print(f"Next: {quadjax_command('sil', folder)}")
    return int(failed)


def _status(text: str) -> None:
    """Replace the last line of stderr, if it is a terminal."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
