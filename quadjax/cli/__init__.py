"""The command ``quadjax``: one module of this package for each subcommand.

A subcommand is a module with a function ``main(arguments)``, which takes the arguments after
the subcommand's name and returns the exit status (None is 0). A module whose name is a keyword of
Python ends with an underscore. Modules are imported when they are needed. Exit status: 0 for
success, 1 for a failed check or training, 2 for bad input or a system error, 130 for Ctrl-C.
"""

import importlib
import keyword
import os
import sys
import time
from collections.abc import Sequence
from typing import NoReturn

from quadjax.core.errors import INTERRUPTED, InputError, run_command
from quadjax.core.interruptions import loading

STARTED = time.monotonic()  # training time counts from here: imports and compilation included

COMMANDS = {  # by name, which is that of the module: one line of help
    "train": "train a racing policy",
    "evaluate": "time the laps of a policy and draw them",
    "results": "tabulate mean and sampled flights of policies",
    "view": "write flights as an interactive 3D page",
    "watch": "show a run or a sweep in the browser while it trains",
    "limit": "compute the best known lap of a track and a lower bound",
    "limit-table": "compute best known laps and lower bounds of several drones",
    "seeds": "train over several seeds and compare them",
    "sweep": "search hyperparameters",
    "fit": "fit the model of a drone to its flight logs",
    "replay": "replay a flight log through a policy and a model",
    "export": "convert a policy to fixed-point C",
    "import": "convert a network of another project to a policy or residual file",
    "verify": "build, run and check exported C",
    "sil": "fly exported C, or your own autopilot, on a simulated drone",
    "compare": "compare E2E with INDI, in simulation and on the plant",
    "report": "write the tables and figures of flights",
    "adaptation": "evaluate a policy on drones that differ from their model",
    "probe": "measure what a policy's layers tell about the drone",
    "specialize": "write the policy of one drone, from one that observes constants",
    "drones": "write vehicle files of drawn drones",
    "simulate-logs": "write flight logs of a known model",
    "recovery": "compare a fit with that known model",
    "plant-logs": "write flight logs of the stand-in plant",
    "improve": "improve a policy by its own flights",
    "identify": "identify the inner loop's time constants",
    "consistency": "check the navigation filter's covariance",
    "benchmark": "measure the speed of this machine",
    "vehicle": "describe a vehicle file or write one",
    "track": "describe a track or write a random one",
    "config": "print a resolved config",
    "presets": "list the presets",
}


def main(command: str | None = None, arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a subcommand and exit with its status.

    Args:
        command: the subcommand; the first argument if not given.
        arguments: the arguments after it; those of ``sys.argv`` if not given.
    """
    argv = list(sys.argv[1:] if arguments is None else arguments)
    status = run(argv if command is None else [command, *argv])
    if status == INTERRUPTED:  # without waiting for threads, which may be compiling
        if sys.stdout is not None:
            sys.stdout.flush()
        os._exit(status)
    sys.exit(status)


def run(argv: list[str]) -> int:
    """Import and run the subcommand of a command line; returns the exit status."""
    return run_command(lambda: _run(argv))


def _run(argv: list[str]) -> int | None:
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(usage())
        return 0 if argv else 2
    if argv[0] in ("-V", "--version"):
        from quadjax import __version__

        print(f"quadjax {__version__}")
        return 0
    if argv[0] not in COMMANDS:
        from quadjax.core.yaml_files import close_match

        hint = close_match(argv[0], list(COMMANDS))
        raise InputError(f"{argv[0]!r} is not a subcommand{hint}; allowed: {', '.join(COMMANDS)}")
    with loading():
        name = argv[0].replace("-", "_") + "_" * keyword.iskeyword(argv[0])
        module = importlib.import_module(f"quadjax.cli.{name}")
    return module.main(argv[1:])


def usage() -> str:
    """The text of ``quadjax --help``."""
    lines = [f"  {name:<14} {text}" for name, text in COMMANDS.items()]
    return "\n".join(
        [
            "usage: quadjax SUBCOMMAND ...",
            "",
            "Train racing policies for quadcopters and convert them to fixed-point C.",
            "",
            *lines,
            "",
            "quadjax SUBCOMMAND --help describes a subcommand; quadjax --version the version.",
        ]
    )
