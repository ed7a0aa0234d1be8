"""The command ``quadjax``: one module of this package for each subcommand.

A subcommand is a module with a function ``main(arguments)``, which takes the arguments after
the subcommand's name and returns the exit status (None is 0). Modules are imported when they are
needed. Exit status: 0 for success, 1 for a failed check or training, 2 for bad input or a system
error, 130 for Ctrl-C.
"""

import importlib
import sys
import time
from collections.abc import Sequence
from typing import NoReturn

from quadjax.core.errors import InputError, run_command
from quadjax.core.interruptions import loading

STARTED = time.monotonic()  # training time counts from here: imports and compilation included

COMMANDS = {  # name: (module, one line of help)
    "train": ("quadjax.cli.train", "train a racing policy"),
    "evaluate": ("quadjax.cli.evaluate", "time the laps of a policy, draw them"),
    "seeds": ("quadjax.cli.seeds", "train over several seeds and compare them"),
    "sweep": ("quadjax.cli.sweep", "search hyperparameters"),
    "fit": ("quadjax.cli.fit", "fit the model of a drone to its flight logs"),
    "export": ("quadjax.cli.export", "convert a policy to fixed-point C"),
    "verify": ("quadjax.cli.verify", "build, run and check exported C"),
    "compare": ("quadjax.cli.compare", "compare E2E with INDI, in simulation and on the plant"),
    "simulate-logs": ("quadjax.fitting.simulate", "write flight logs of a known model"),
    "recovery": ("quadjax.studies.recovery", "compare a fit with that known model"),
    "plant-logs": ("quadjax.plant.logs", "write flight logs of the stand-in plant"),
    "identify": ("quadjax.studies.identify", "identify the inner loop's time constants"),
    "consistency": ("quadjax.studies.consistency", "check the navigation filter's covariance"),
    "benchmark": ("quadjax.cli.benchmark", "measure the speed of this machine"),
    "config": ("quadjax.cli.config", "print a resolved config"),
    "presets": ("quadjax.cli.presets", "list the presets"),
}


def main(command: str | None = None, arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a subcommand and exit with its status.

    Args:
        command: the subcommand; the first argument if not given.
        arguments: the arguments after it; those of ``sys.argv`` if not given.
    """
    argv = list(sys.argv[1:] if arguments is None else arguments)
    sys.exit(run_command(lambda: _run(argv if command is None else [command, *argv])))


def _run(argv: list[str]) -> int | None:
    """Import and run the subcommand of a command line."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(usage())
        return 0 if argv else 2
    if argv[0] in ("-V", "--version"):
        from quadjax import __version__

        print(f"quadjax {__version__}")
        return 0
    if argv[0] not in COMMANDS:
        raise InputError(f"{argv[0]!r} is not a subcommand, allowed: {', '.join(COMMANDS)}")
    with loading():
        module = importlib.import_module(COMMANDS[argv[0]][0])
    return module.main(argv[1:])


def usage() -> str:
    """The text of ``quadjax --help``."""
    lines = [f"  {name:<14} {text}" for name, (_, text) in COMMANDS.items()]
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
