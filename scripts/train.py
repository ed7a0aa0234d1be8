"""Train a racing policy: python scripts/train.py configs/FILE.yaml [key=value ...]."""

import time

STARTED = time.monotonic()  # training time counts from here: imports and compilation included

import argparse  # noqa: E402
import shlex  # noqa: E402
import sys  # noqa: E402
from pathlib import Path  # noqa: E402

from quadjax.cli.arguments import Parser, count, parse  # noqa: E402
from quadjax.config.loading import load_config  # noqa: E402
from quadjax.core.errors import INTERRUPTED, InputError, command_line  # noqa: E402
from quadjax.learners.devices import prepare_devices  # noqa: E402


def parse_arguments() -> argparse.Namespace:
    """The command line."""
    parser = Parser(
        description="Train a racing policy. Everything is left in runs/NAME: the config, the "
        "metrics, the checkpoints, the policy file, the lap table and the figures.",
        epilog="Example: python scripts/train.py configs/e2e_shac.yaml seed=3 name=third "
        "train.steps=5000000",
    )
    parser.add_argument("config", help="YAML file, such as configs/e2e_shac.yaml")
    parser.add_argument(
        "words", nargs="*", metavar="key=value", help="overrides, such as ppo.epochs=4"
    )
    parser.add_argument("--resume", action="store_true", help="go on from the last checkpoint")
    parser.add_argument(
        "--overwrite", action="store_true", help="delete an earlier run of the same name"
    )
    parser.add_argument(
        "--coordinator",
        metavar="HOST:PORT",
        help="train over several processes: where the first one listens, or auto on a cluster",
    )
    parser.add_argument("--processes", type=count, help="how many processes there are")
    parser.add_argument("--process", type=int, help="which of them this one is, from 0")
    parser.add_argument("--runs", default="runs", metavar="DIR", help="where runs go (runs)")
    return parse(parser)


@command_line
def main() -> int:
    """Train, then print and keep the results."""
    arguments = parse_arguments()
    config = load_config(arguments.config, arguments.words)
    directory = Path(arguments.runs) / config.name
    if arguments.overwrite and arguments.resume:
        raise InputError("--overwrite and --resume exclude each other")
    prepare_devices(config.train.devices)
    from quadjax.learners import hosts

    hosts.connect(arguments.coordinator, arguments.processes, arguments.process)
    from quadjax.evaluation.results import present
    from quadjax.learners.loop import NonFiniteError
    from quadjax.training.run import train

    try:
        result = train(config, directory, arguments.resume, STARTED, overwrite=arguments.overwrite)
    except NonFiniteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    if not hosts.is_first():
        return 0 if result.finished else INTERRUPTED
    if not result.finished:
        again = [arguments.config, *arguments.words, "--resume", "--runs", arguments.runs]
        print(f"Stopped and saved. Go on with: python scripts/train.py {shlex.join(again)}")
        return INTERRUPTED
    present(config, result)
    return 0


if __name__ == "__main__":
    main()
