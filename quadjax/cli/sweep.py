"""Search a space of training configs.

The same command continues a sweep that was stopped and, where storage is a database, lets another
machine take part. DIR/NAME gets the trials, their table, figures and the best config.
"""

import argparse
import shlex
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from quadjax.cli.arguments import Parser, add_config, add_output, count, parse
from quadjax.core.errors import InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import find_config

if TYPE_CHECKING:
    from quadjax.sweeps.machine import Layout
    from quadjax.sweeps.run import Outcome
    from quadjax.sweeps.schema import Sweep
    from quadjax.sweeps.store import Store


def _arguments(words: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "sweep",
        description=__doc__,
        epilog="Example: quadjax sweep configs/sweeps/learning_rate.yaml budget.trials=40 "
        "--workers 2",
    )
    add_config(parser, "a YAML file, such as configs/sweeps/learning_rate.yaml")
    parser.add_argument("--workers", type=count, help="processes, each pinned to a core (all)")
    parser.add_argument(
        "--vmap", type=count, metavar="N", help="runs that a worker trains in one program"
    )
    parser.add_argument(
        "--calibrate",
        action="store_true",
        help="measure which --workers and --vmap are fastest here, and save them",
    )
    parser.add_argument("--check", action="store_true", help="check the sweep and run nothing")
    parser.add_argument("--report", action="store_true", help="only report the finished trials")
    parser.add_argument("--overwrite", action="store_true", help="remove the trials first")
    add_output(parser)
    return parse(parser, words)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is left of the sweep, then report."""
    words = _arguments(arguments)
    with loading():
        from quadjax.sweeps import machine
        from quadjax.sweeps.schema import load_sweep

    sweep = load_sweep(find_config(words.config, "sweeps"), words.overrides)
    directory = words.output / sweep.file.name

    seeds = sweep.file.objective.seeds
    if words.calibrate:
        (directory / machine.CALIBRATION).unlink(missing_ok=True)
    layout = machine.choose_layout(words.workers, words.vmap, directory, seeds)
    if words.check:
        print(f"{words.config}: {sweep.trials} trials of {seeds} seeds can run")
        return 0
    store = _open(sweep, directory, words.overwrite)
    from quadjax.sweeps import run
    from quadjax.sweeps.report import present

    run.check_budget(sweep, store.counts())
    if words.report:
        present(store)
        return 0
    if words.calibrate or not layout.lanes:
        from quadjax.sweeps.calibrate import calibrate

        layout = calibrate(sweep, directory, layout)
    if words.calibrate:
        return 0
    return _run(store, layout, words)


def _open(sweep: "Sweep", directory: Path, overwrite: bool) -> "Store":
    """The sweep's store of trials, anew if asked for."""
    from quadjax.sweeps.store import Store, delete_study

    if overwrite:
        delete_study(sweep, directory)
        shutil.rmtree(directory, ignore_errors=True)
    if not (directory / "study.journal").exists() and (directory / "checkpoints").exists():
        raise InputError(f"{directory} holds a training run; choose another name=NAME")
    return Store(sweep, directory)


def _run(store: "Store", layout: "Layout", words: argparse.Namespace) -> int:
    """Run what is left, report, and say how it ended."""
    from quadjax.sweeps import run
    from quadjax.sweeps.report import present

    sweep, before = store.sweep, store.counts().done
    print(
        f"{sweep.file.name}: {sweep.trials} trials, {layout.workers} workers, "
        f"{layout.lanes} runs in a program ({layout.why})",
        flush=True,
    )
    runs = words.output
    try:
        outcome = run.run_sweep(store, words.config, words.overrides, runs, layout)
    except run.WorkersFailError as error:
        print(f"error: {error}")
        return 1
    present(store)
    print(f"{outcome.counts.done - before} trials in {outcome.seconds:.0f} s of wall time")
    return _end(outcome, words)


def _end(outcome: "Outcome", words: argparse.Namespace) -> int:
    """What to say last, and the exit status."""
    if outcome.counts.open:
        again = shlex.join([words.config, *words.overrides])
        why = "Stopped" if outcome.interrupted else "Out of time"
        print(f"{why}: {outcome.counts.done} trials done, {outcome.counts.open} to do.")
        print(f"Continue with: quadjax sweep {again}")
        return 130 if outcome.interrupted else 0
    if outcome.counts.failed:
        print(f"{outcome.counts.failed} trials failed; see the table")
        return 1
    return 0
