"""The command ``quadjax``: one module of this package for each subcommand.

A subcommand is a function of its module's name. Its signature declares the arguments and options,
which cyclopts reads; its docstring is their help. It returns the exit status (None is 0). Modules
are imported when they are needed. Exit status: 0 for success, 1 for a failed check or training, 2
for bad input or a system error, 130 for Ctrl-C.
"""

import importlib
import io
import keyword
import os
import re
import sys
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NoReturn

from quadjax.core.errors import INTERRUPTED, InputError, as_command, close_match
from quadjax.core.interruptions import loading, repeat_lost

if TYPE_CHECKING:
    from cyclopts import App

STARTED = time.monotonic()  # training time counts from here: imports and compilation included

COMMANDS = {  # by name, which is that of the module: one line of help
    "train": "train a racing policy, with one seed or several",
    "evaluate": "time the laps of policies and draw them",
    "report": "write tables and figures of recorded flights",
    "view": "write flights as an interactive 3D page",
    "limit": "compute the best known lap of a track",
    "sweep": "search hyperparameters",
    "fit": "fit the model of a drone to its flight logs",
    "replay": "replay a flight log through a policy and a model",
    "compare": "compare E2E with INDI, in simulation and on a plant",
    "export": "convert a policy to fixed-point C",
    "verify": "build, run and check exported C",
    "sil": "fly exported C on a simulated drone",
    "import": "convert a network of another project to a policy or residual file",
    "logs": "write flight logs of a plant or of a known model",
    "show": "list presets, tracks, vehicles and policies; print one",
}


def main(command: str | None = None, arguments: Sequence[str] | None = None) -> NoReturn:
    """Run a subcommand and exit with its status.

    Args:
        command: the subcommand; the first argument if not given.
        arguments: the arguments after it; those of ``sys.argv`` if not given.
    """
    repeat_lost()
    argv = list(sys.argv[1:] if arguments is None else arguments)
    prepare_process()
    status = run(argv if command is None else [command, *argv])
    if status == INTERRUPTED:  # without waiting for threads, which may be compiling
        if sys.stdout is not None:
            sys.stdout.flush()
        os._exit(status)
    sys.exit(status)


def prepare_process() -> None:
    """Let no setting of the environment end a command after its work.

    Characters that the encoding of an output stream lacks are replaced. Figures are files, so the
    backend of Matplotlib's windows has no effect, also if it is none. JAX computes in single
    precision (``quadjax.core.precision``).
    """
    os.environ |= {"MPLBACKEND": "agg", "JAX_ENABLE_X64": "0"}
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper) and stream.errors in ("strict", "surrogateescape"):
            stream.reconfigure(errors="replace")


@as_command
def run(argv: list[str]) -> int | None:
    """Import and run the subcommand of a command line; returns the exit status."""
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(usage())
        return 0 if argv else 2
    if argv[0] in ("-V", "--version"):
        from quadjax import __version__

        print(f"quadjax {__version__}")
        return 0
    if argv[0] not in COMMANDS:
        hint = close_match(argv[0], list(COMMANDS))
        raise InputError(f"{argv[0]!r} is not a subcommand{hint}; allowed: {', '.join(COMMANDS)}")
    with loading():
        name = argv[0] + "_" * keyword.iskeyword(argv[0])
        command = getattr(importlib.import_module(f"quadjax.cli.{name}"), name)
    return call(command, f"quadjax {argv[0]}", argv[1:])


def call(command: Callable[..., int | None], name: str, argv: Sequence[str]) -> int | None:
    """Call a function with the arguments of a command line; returns its result.

    Args:
        command: its signature declares the arguments and options.
        name: of the command, for its help.
        argv: the arguments.

    Raises:
        InputError: an unknown option, a missing argument, or a value that is not allowed.
    """
    with loading():
        from cyclopts import CycloptsError, MissingArgumentError

        from quadjax.cli.files import check_outputs
        from quadjax.cli.output import ARGUMENTS

    app = application(command, name)
    if {"-h", "--help"} & set(argv):
        app.help_print([])
        return 0
    for text in argv:
        if re.fullmatch(r"-{1,2}[A-Za-z][^=]*=--?", text):
            raise InputError(f"{text}: expected a value after the = (try --help)")
    try:
        _, bound, _ = app.parse_args(list(argv), exit_on_error=False, print_error=False)
    except CycloptsError as error:
        text = str(error).removesuffix(".")
        option = None if error.argument is None else error.argument.name
        if option and option not in argv and isinstance(error, MissingArgumentError):
            text = f"{option} is missing"
        elif option is not None and option not in text:
            text = f"Invalid value for {option}: {text}"
        raise InputError(f"{text} (try --help)") from error
    check_outputs(command, bound.arguments)
    ARGUMENTS.set([*name.split(maxsplit=1), *argv])
    return command(*bound.args, **bound.kwargs)


def script(command: Callable[..., int | None]) -> NoReturn:
    """Run a function as a script with the arguments of the command line, and exit."""
    name = f"python {sys.argv[0]}"
    prepare_process()
    sys.exit(as_command(call)(command, name, sys.argv[1:]))


def application(command: Callable[..., Any], name: str) -> "App":
    """The parser of a command and the writer of its help."""
    from cyclopts import App, Group, Parameter

    return App(
        name=name,
        default_command=command,
        default_parameter=Parameter(negative=()),
        help_format="markdown",
        help_flags=[],
        version_flags=[],
        group_parameters=Group("Options", sort_key=1),
    )


def usage() -> str:
    """The text of ``quadjax --help``."""
    lines = "\n".join(f"  {name:<10} {text}" for name, text in COMMANDS.items())
    return f"""Usage: quadjax SUBCOMMAND ...

Train racing policies for quadcopters and convert them to fixed-point C.

{lines}

quadjax SUBCOMMAND --help describes a subcommand; quadjax --version the version."""
