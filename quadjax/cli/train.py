"""Train a racing policy.

DIR/NAME gets the config, the metrics, the checkpoints, the policy file, the lap table and the
figures. The same command with --resume continues a run that was stopped.
"""

import argparse
import shlex
import sys
from collections.abc import Sequence

from quadjax.cli import STARTED
from quadjax.cli.arguments import (
    Parser,
    add_config,
    add_name,
    add_output,
    count,
    overrides_of,
    parse,
)
from quadjax.core.errors import INTERRUPTED, InputError
from quadjax.core.interruptions import loading
from quadjax.core.resources import find_config


def _arguments(words: Sequence[str] | None) -> argparse.Namespace:
    parser = Parser(
        "train",
        description=__doc__,
        epilog="Example: quadjax train e2e_shac seed=3 train.steps=5000000 --name third",
    )
    add_config(parser)
    add_name(parser)
    add_output(parser)
    parser.add_argument("--resume", action="store_true", help="continue from the last checkpoint")
    parser.add_argument(
        "--overwrite", action="store_true", help="remove an earlier run of the same name first"
    )
    parser.add_argument(
        "--coordinator",
        metavar="HOST:PORT",
        help="train over several processes: the address of the first one, or auto on a cluster",
    )
    parser.add_argument("--processes", type=count, help="number of processes")
    parser.add_argument("--process", type=int, help="index of this process, from 0")
    arguments = parse(parser, words)
    if arguments.overwrite and arguments.resume:
        raise InputError("--overwrite and --resume exclude each other")
    return arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, then print and save the results."""
    words = _arguments(arguments)
    with loading():
        from quadjax.config.loading import load_config
        from quadjax.learners import hosts
        from quadjax.learners.devices import prepare_devices

    config = load_config(find_config(words.config), overrides_of(words))
    prepare_devices(config.train.devices)
    hosts.connect(words.coordinator, words.processes, words.process)
    with loading():
        from quadjax.evaluation.results import present
        from quadjax.learners.loop import NonFiniteError
        from quadjax.training.run import train

    folder = words.output / config.name
    try:
        run = train(
            config,
            folder,
            resume=words.resume,
            overwrite=words.overwrite,
            started=STARTED,
        )
    except NonFiniteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if not run.finished:
        if hosts.is_first():
            print(f"Stopped and saved. Continue with: {_again(words)}")
        return INTERRUPTED
    if hosts.is_first():
        present(run)
    return 0


def _again(words: argparse.Namespace) -> str:
    """The command that resumes a stopped run."""
    command = ["quadjax", "train", words.config, *overrides_of(words), "--resume"]
    if str(words.output) != "runs":
        command += ["--output", str(words.output)]
    return shlex.join(command)
