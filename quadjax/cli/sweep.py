"""Search a space of training configs.

The same command resumes a sweep that was stopped or killed. With a database as storage, the same
command on another machine runs trials of the same sweep. DIR/NAME gets the trials, their table,
figures and the best config.
"""

import argparse
import time
from collections.abc import Sequence

from quadjax.cli.arguments import Parser, add_config, add_output, count, names_of, parse
from quadjax.core.errors import INTERRUPTED
from quadjax.core.folders import check_free, check_kind, claim, remove_files
from quadjax.core.interruptions import loading
from quadjax.core.resources import find_config

FILES = (  # written by a sweep
    "study.journal*",
    "trials",
    "trials.csv",
    "logs",
    "report.md",
    "best.yaml",
    "parallel.png",
    "slices.png",
)


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "sweep",
        description=__doc__,
        epilog="Example: quadjax sweep learning_rate budget.trials=40",
    )
    add_config(parser, names_of("sweeps"))
    parser.add_argument("--workers", type=count, help="trials at the same time (executor.workers)")
    parser.add_argument("--check", action="store_true", help="check the sweep and run nothing")
    parser.add_argument("--report", action="store_true", help="only report the finished trials")
    parser.add_argument("--overwrite", action="store_true", help="remove the trials first")
    add_output(parser)
    return parse(parser, argv)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the remaining trials of a sweep, then report."""
    options = _arguments(arguments)
    with loading():
        from quadjax.sweeps import study as studies
        from quadjax.sweeps.report import write_report
        from quadjax.sweeps.sweep import load_sweep

    workers = [f"executor.workers={options.workers}"] if options.workers else []
    sweep = load_sweep(find_config(options.config, "sweeps"), [*options.overrides, *workers])
    directory = options.output / sweep.file.name
    if options.check:
        seeds = sweep.file.objective.seeds
        print(f"{options.config}: {sweep.trials} trials of {seeds} seeds can run")
        return 0
    if options.report:
        check_kind(directory, "sweep")
        if not options.overwrite:
            check_free(directory, "sweep", FILES)
        study = studies.open_study(sweep, directory, run=False)
        print(write_report(study, sweep, directory))
        return 0
    from quadjax.sweeps.run import make_executor, run_sweep

    with claim(directory, "sweep", FILES, options.overwrite):
        if options.overwrite:
            studies.delete_study(sweep, directory)
            remove_files(directory, FILES)
        with make_executor(sweep, directory) as executor:
            study = studies.open_study(sweep, directory)
            kind = sweep.file.executor.kind
            print(f"{sweep.file.name}: {sweep.trials} trials, {executor.workers} workers ({kind})")
            started = time.monotonic()
            ended = run_sweep(study, sweep, directory, executor)
        print(write_report(study, sweep, directory))
    counts = studies.count(study)
    to_do = sweep.trials - counts.done - counts.failed
    seconds = time.monotonic() - started
    print(f"{counts.done} trials done, {to_do} to do, {seconds:.0f} s of wall time")
    if to_do:
        print("The same command runs the rest.")
        return 0 if ended else INTERRUPTED
    if counts.failed:
        print(f"{counts.failed} trials failed; see the table")
    return 1 if counts.failed else 0
