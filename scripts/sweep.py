"""Sweep a training config: python scripts/sweep.py configs/sweeps/NAME.yaml [key=value ...]."""

import argparse
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from quadjax.cli.arguments import Parser, count, parse
from quadjax.core.errors import InputError, command_line

if TYPE_CHECKING:  # imported late: --help and bad input need none of it
    from quadjax.sweeps.machine import Layout
    from quadjax.sweeps.schema import Sweep
    from quadjax.sweeps.store import Store


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = Parser(
        description="Search a space of training configs. The same command goes on with a sweep "
        "that was stopped, and, where storage is a database, lets another machine help. Trials, "
        "their table, figures and the best config are left in runs/NAME/.",
        epilog="Example: python scripts/sweep.py configs/sweeps/learning_rate.yaml "
        "budget.trials=40 --workers 2",
    )
    parser.add_argument("sweep", help="YAML file, such as configs/sweeps/learning_rate.yaml")
    parser.add_argument(
        "words", nargs="*", metavar="key=value", help="changes, such as budget.trials=40"
    )
    parser.add_argument("--workers", type=count, help="processes, each pinned to a core (all)")
    parser.add_argument(
        "--vmap", type=count, metavar="N", help="runs that a worker trains in one program"
    )
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="measure and keep which workers and --vmap are fastest here",
    )
    parser.add_argument("--check", action="store_true", help="check the sweep and run nothing")
    parser.add_argument("--report", action="store_true", help="only report what there is")
    parser.add_argument("--overwrite", action="store_true", help="forget the trials there are")
    parser.add_argument("--runs", default="runs", metavar="DIR", help="where runs go (runs)")
    return parse(parser)


@command_line
def main() -> int:
    """Run what is left of the sweep, then report."""
    arguments = parse_arguments()
    from quadjax.sweeps.schema import load_sweep

    sweep = load_sweep(arguments.sweep, arguments.words)
    directory = Path(arguments.runs) / sweep.file.name
    from quadjax.sweeps import machine

    seeds = sweep.file.objective.seeds
    if arguments.calibrate:
        (directory / machine.CALIBRATION).unlink(missing_ok=True)
    layout = machine.choose_layout(arguments.workers, arguments.vmap, directory, seeds)
    if arguments.check:
        print(f"{arguments.sweep}: {sweep.trials} trials of {seeds} seeds can run")
        return 0
    store = _open(sweep, directory, arguments.overwrite)
    from quadjax.sweeps import run
    from quadjax.sweeps.report import present

    run.check_budget(sweep, store.counts())
    if arguments.report:
        present(store)
        return 0
    if arguments.calibrate or not layout.lanes:
        from quadjax.sweeps.calibrate import calibrate

        layout = calibrate(sweep, directory, layout)
    if arguments.calibrate:
        return 0
    return _run(store, layout, arguments)


def _open(sweep: "Sweep", directory: Path, overwrite: bool) -> "Store":
    """The sweep's store of trials, anew if asked for."""
    from quadjax.sweeps.store import Store, delete_study

    if overwrite:
        delete_study(sweep, directory)
        shutil.rmtree(directory, ignore_errors=True)
    if not (directory / "study.journal").exists() and (directory / "checkpoints").exists():
        raise InputError(f"{directory} holds a training run; choose another name=NAME")
    return Store(sweep, directory)


def _run(store: "Store", layout: "Layout", arguments: argparse.Namespace) -> int:
    """Run what is left, report, and say how it ended."""
    from quadjax.sweeps import run
    from quadjax.sweeps.report import present

    sweep, before = store.sweep, store.counts().done
    print(
        f"{sweep.file.name}: {sweep.trials} trials, {layout.workers} workers, "
        f"{layout.lanes} runs in a program ({layout.why})",
        flush=True,
    )
    runs = Path(arguments.runs)
    try:
        outcome = run.run_sweep(store, arguments.sweep, arguments.words, runs, layout)
    except run.WorkersFailError as error:
        print(f"error: {error}")
        return 1
    present(store)
    print(f"{outcome.counts.done - before} trials in {outcome.seconds:.0f} s of wall time")
    return _end(outcome, arguments)


def _end(outcome: object, arguments: argparse.Namespace) -> int:
    """What to say last, and the exit status."""
    if outcome.counts.open:
        again = " ".join([arguments.sweep, *arguments.words])
        why = "Stopped" if outcome.interrupted else "Out of time"
        print(f"{why}: {outcome.counts.done} trials done, {outcome.counts.open} to do.")
        print(f"Go on with: python scripts/sweep.py {again}")
        return 130 if outcome.interrupted else 0
    if outcome.counts.failed:
        print(f"{outcome.counts.failed} trials failed; see the table")
        return 1
    return 0


if __name__ == "__main__":
    main()
