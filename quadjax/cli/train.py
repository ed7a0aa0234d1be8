"""Train a racing policy.

DIR/NAME gets the config, the metrics, the checkpoints, the policy file, the
lap table and the figures. The same command with --resume continues a run that
was stopped.
"""

import argparse
import shlex
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from quadjax.cli import STARTED
from quadjax.cli.arguments import (
    Parser,
    add_config,
    add_name,
    add_output,
    overrides_of,
    parse,
)
from quadjax.cli.watch import start
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.interruptions import loading

if TYPE_CHECKING:
    from quadjax.config.schema import Config
    from quadjax.training.result import Run


def _arguments(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "train",
        description=__doc__,
        epilog="Example: quadjax train e2e_shac seed=3 run.steps=5000000 --name third",
    )
    add_config(parser)
    add_name(parser)
    add_output(parser)
    parser.add_argument("--resume", action="store_true", help="continue from the last checkpoint")
    parser.add_argument(
        "--overwrite", action="store_true", help="remove an earlier run of the same name first"
    )
    parser.add_argument(
        "--fine-tune",
        metavar="FILE.npz",
        help="continue from a policy and its critic, with all schedules at their ends",
    )
    parser.add_argument(
        "--watch", action="store_true", help="show the training in the browser; see quadjax watch"
    )
    arguments = parse(parser, argv)
    if arguments.overwrite and arguments.resume:
        raise InputError("--overwrite and --resume exclude each other")
    return arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, then print and save the results."""
    options = _arguments(arguments)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.config.stored import names_of_code
        from quadjax.learners.devices import prepare_devices
        from quadjax.training.fine_tuning import fine_tuning

    config = load_config(options.config, overrides_of(options))
    if options.fine_tune:
        _check_fine_tuning(config, options.fine_tune)
        config = fine_tuning(config, options.fine_tune)
    prepare_devices(config.run.devices)
    with loading():
        from quadjax.learners.loop import NonFiniteError
        from quadjax.training.run import train

    folder = options.output / config.name
    if options.watch:
        race = [options.config, *overrides_of(options)] if names_of_code(config) else []
        print(f"watch: {start(folder, race)}", file=sys.stderr, flush=True)
    try:
        run = train(
            config,
            folder,
            resume=options.resume,
            overwrite=options.overwrite,
            started=STARTED,
        )
    except NonFiniteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if not run.finished:
        print(f"Stopped and saved. Continue with: {_again(options)}")
        return INTERRUPTED
    _present(run)
    return 0


def _check_fine_tuning(config: "Config", file: str) -> None:
    from quadjax.policy.file import Policy

    if config.run.initial_policy is not None:
        raise InputError("--fine-tune and run.initial_policy exclude each other")
    if Policy.load(file).value is None:
        raise InputError(
            f"--fine-tune: {file} has no critic, allowed: a policy with one; "
            f"run.initial_policy={file} starts with an untrained critic"
        )


def _again(options: argparse.Namespace) -> str:
    """The command that resumes a stopped run."""
    command = ["quadjax", "train", options.config, *overrides_of(options), "--resume"]
    if options.fine_tune:
        command += ["--fine-tune", options.fine_tune]
    if str(options.output) != "runs":
        command += ["--output", str(options.output)]
    return shlex.join(command)


def _present(run: "Run") -> None:
    """Evaluate the best policy, print its lap table and write table and figures to the folder."""
    with loading():
        from rich.console import Console

        from quadjax.core.files import write_json
        from quadjax.core.plotting import save_figure
        from quadjax.evaluation.curves import training_figure
        from quadjax.evaluation.evaluation import evaluate, lap_table
        from quadjax.training.advice import no_lap
        from quadjax.training.paper import published_total

    config, folder, name = run.config, run.folder, str(run.folder / "policy.npz")
    with Console(stderr=True).status("timing laps and drawing"):
        sampled = evaluate(run.policy, config, name=name)
        steady = evaluate(run.policy, config, deterministic=True, name=name)
        write_json(folder / "laps.json", sampled.to_json())
        write_json(folder / "laps_deterministic.json", steady.to_json())
        save_figure(steady.plot(), folder / "trajectory.png")
        metrics = run.metrics
        if len(metrics["steps"]):
            curves = training_figure({config.name: metrics}, config.name, published_total(config))
            save_figure(curves, folder / "curves.png")
    if not len(metrics["steps"]):
        print(f"{folder / 'metrics.csv'}: no rows, so there are no curves of the training")
    print(lap_table({each.label(): each for each in (sampled, steady)}))
    print(_report(run))
    if run.summary["best_lap_total"] is None:
        print(no_lap((*sampled.laps.crashes, *steady.laps.crashes), run.summary["steps"]))


def _amount(number: int) -> str:
    return f"{number / 1e6:.1f} million" if number >= 1e5 else f"{number:,}"


def _report(run: "Run") -> str:
    """Steps, time, memory and the folder of a run, as text."""
    summary, devices = run.summary, run.summary["devices"]
    first, memory = summary.get("first_under"), summary.get("peak_memory_mib")
    line = (
        f"trained {_amount(summary['steps'])} steps in {summary['seconds']:.0f} s on "
        f"{devices} device{'' if devices == 1 else 's'}"
    )
    lines = [line if memory is None else f"{line}, {memory:.0f} MiB at most"]
    if first and first["seconds"] is not None:
        lines.append(
            f"first under {first['total']:.2f} s after {first['seconds']:.0f} s and "
            f"{_amount(first['steps'])} steps"
        )
    return "\n".join([*lines, f"policy, figures and metrics are in {run.folder}"])
