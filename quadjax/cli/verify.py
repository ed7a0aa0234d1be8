"""``quadjax verify``."""

import dataclasses
import sys
from typing import Annotated

from cyclopts import Parameter

from quadjax.cli import options as opt
from quadjax.cli.output import wrote
from quadjax.core.errors import quadjax_command
from quadjax.core.files import write_json
from quadjax.core.interruptions import loading
from quadjax.export.names import POLICY_FILE, report_of


def verify(
    folder: Annotated[opt.Export, Parameter(name="DIR")],
    /,
    *,
    vectors: Annotated[int, opt.whole(100, 10**6)] = 5_000,
    allow_unfinished: opt.AllowUnfinished = False,
    allow_other_race: opt.AllowOtherRace = False,
    race: opt.Race = None,
    json: opt.JsonFile = None,
) -> int:
    """Convert an exported policy again, build its C, and compare both.

    A C compiler of this machine, or the one that pip installs (pip install
    'quadjax[verify]'), is enough. A check that does not apply is skipped, with the
    reason. Exit status 0: no check failed.

    Example: quadjax verify out/ --json verification.json

    Args:
        folder: Folder of quadjax export.
        vectors: Inputs on which C and NumPy must agree.
        race: Config of the race, if that of DIR names your own code (config.yaml of DIR).
        json: Write the table.
    """
    report_of(folder)
    with loading():
        from quadjax.core.provenance import provenance
        from quadjax.export.verify import CHECKS, FAILED, Result
        from quadjax.export.verify import verify as verify_folder

    def report(result: Result) -> None:
        _status("")
        print(result.text(max(map(len, CHECKS))), flush=True)

    results = verify_folder(
        folder,
        vectors,
        allow_unfinished=allow_unfinished,
        allow_other_race=allow_other_race,
        config=race,
        report=report,
        announce=lambda name: _status(f"{name} .."),
    )
    if json is not None:
        rows = [dataclasses.asdict(result) for result in results]
        source = provenance(policy=folder / POLICY_FILE)
        write_json(json, {"results": rows, "provenance": source})
    wrote(json)
    failed = any(result.verdict == FAILED for result in results)
    if not failed:
        print(f"Next: {quadjax_command('sil', folder)}")
    return int(failed)


def _status(text: str) -> None:
    """Replace the last line of stderr, if it is a terminal."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
