"""Common options and checks of the subcommands."""

import argparse
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from quadjax.core.errors import InputError, writing
from quadjax.core.files import check_file
from quadjax.core.limits import MAX_GATES, MAX_LAPS, MAX_RUNS, MAX_SEED
from quadjax.core.resources import find_policy, preset_names
from quadjax.core.sections import FOLDER_NAME
from quadjax.core.yaml_files import close_match, short


def whole(least: int, most: int) -> Callable[[str], int]:
    """A ``type=`` for integers from ``least`` to ``most``."""

    def number(text: str) -> int:
        value = int(text) if text.isascii() and text.isdigit() and len(text) < 19 else least - 1
        if not least <= value <= most:
            expected = f"expected an integer, {least} to {most}"
            raise argparse.ArgumentTypeError(f"{short(text)}, {expected}")
        return value

    return number


def positive(text: str) -> float:
    """A number above 0, at most 50, for ``type=``."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value <= 50:
        raise argparse.ArgumentTypeError(f"{short(text)}, expected a number above 0, at most 50")
    return value


FILE_OVERRIDE = re.compile(  # the key of an override whose value is a file
    r"^([\w.]+\.)?(vehicle|track|file|residual|initial_policy|start_states|config)="
)
POLICIES = {"policy", "e2e", "indi", "without"}  # options that name policy files
seed, laps, runs = whole(0, MAX_SEED), whole(1, MAX_LAPS), whole(1, MAX_RUNS)
gates = whole(1, MAX_GATES)
count = whole(1, 10**6)


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line: an ``InputError``."""

    def __init__(self, command: str | None = None, **options: Any) -> None:
        """Create the parser of ``quadjax COMMAND``; options as of ``ArgumentParser``."""
        if command is not None:
            options["prog"] = f"quadjax {command}"
        options.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        """Raise an ``InputError``."""
        raise InputError(f"{message} (try --help)")


def parse(parser: Parser, arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse options and positional arguments in any order.

    Raises:
        InputError: unknown options (the first one is named), missing or bad values.
    """
    argv = list(sys.argv[1:] if arguments is None else arguments)
    for text in argv:
        if re.fullmatch(r"-{1,2}[A-Za-z][^=]*=--", text):  # which argparse takes for no value
            raise InputError(f"{text}: expected a value after the = (try --help)")
    known = [name for action in parser._actions for name in action.option_strings]
    for option in (text.partition("=")[0] for text in argv if re.match("-{1,2}[A-Za-z]", text)):
        if option not in known:
            raise InputError(f"unknown option {option}{close_match(option, known)} (try --help)")
    try:
        options = parser.parse_intermixed_args(argv)
    except argparse.ArgumentError as error:
        raise InputError(f"{error} (try --help)") from error
    for key in POLICIES & vars(options).keys():
        setattr(options, key, _shipped(getattr(options, key)))
    return options


def _shipped(value: Any) -> Any:
    """The value of an option that names policy files, with the paths of shipped ones."""
    if isinstance(value, list):
        return [_shipped(each) for each in value]
    return type(value)(find_policy(value)) if isinstance(value, (str, Path)) else value


def add_config(
    parser: argparse.ArgumentParser, kind: str = "a preset's name or a YAML file"
) -> None:
    """Add the arguments CONFIG and key=value ..., as ``config`` and ``overrides``."""
    parser.add_argument("config", metavar="CONFIG", help=kind)
    parser.add_argument(
        "overrides", nargs="*", default=[], metavar="key=value", help="change keys of the config"
    )


def names_of(folder: str) -> str:
    """The names of the configs in a folder of ``configs/``, for a help text."""
    return f"a name ({', '.join(preset_names(folder))}) or a YAML file"


def add_code(parser: argparse.ArgumentParser) -> None:
    """Add ``--allow-code``, for configs of flight logs."""
    parser.add_argument(
        "--allow-code",
        action="store_true",
        help="import the reader of logs that the fit config's file names as module:OBJECT",
    )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add ``--output DIR``, the folder in which a run gets its folder."""
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("runs"),
        metavar="DIR",
        help="write to DIR/NAME (default: runs)",
    )


def add_overwrite(parser: argparse.ArgumentParser, kind: str) -> None:
    """Add ``--overwrite``, for results of this kind."""
    parser.add_argument(
        "--overwrite", action="store_true", help=f"replace an earlier {kind} of the same name"
    )


def add_name(parser: argparse.ArgumentParser) -> None:
    """Add ``--name NAME``, which is short for the override ``name=NAME``."""
    parser.add_argument("--name", type=name, help="name of the run's folder, as name=NAME")


def add_races(parser: argparse.ArgumentParser, start: str = "hover") -> None:
    """Add --laps, --gates, --runs, --start and --seed: how a policy is evaluated."""
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--laps", type=laps, help="laps of a run (default: evaluate.laps)")
    length.add_argument(
        "--gates", type=gates, help="gates of a run, in place of laps (default: evaluate.gates)"
    )
    parser.add_argument("--runs", type=runs, help="number of runs (default: evaluate.runs)")
    parser.add_argument(
        "--start",
        choices=("hover", "random"),
        default=start,
        help=f"start from hover, or from the random states of training (default: {start})",
    )
    parser.add_argument(
        "--seed", type=seed, default=0, help="of noise, disturbances and starts (default: 0)"
    )


def add_ranges(parser: argparse.ArgumentParser, text: str) -> None:
    """Add ``--range FIELD=R``, which may be given several times, as ``ranges``."""
    parser.add_argument(
        "--range", action="append", default=[], dest="ranges", metavar="FIELD=R", help=text
    )


def is_override(text: str) -> bool:
    """Whether an argument is ``key=value``, not a file, whose path may have ``=`` in it."""
    key, equals, _ = text.partition("=")
    return bool(equals) and "/" not in key and not os.path.exists(text)


def overrides_of(arguments: argparse.Namespace) -> list[str]:
    """The overrides of a command line, with --name as ``name=NAME``."""
    extra = [f"name={arguments.name}"] if getattr(arguments, "name", None) else []
    return [*arguments.overrides, *extra]


def name(text: str) -> str:
    """The name of a folder, for ``type=``."""
    if not re.fullmatch(FOLDER_NAME, text):
        raise argparse.ArgumentTypeError(
            f"{text!r}, expected letters, digits, '_', '.' and '-', the last two not first"
        )
    return text


def check_writable(path: Path | str | None, suffixes: Sequence[str] = ()) -> None:
    """Refuse an output path before any work is done; None is accepted.

    Args:
        path: of a file to write.
        suffixes: the allowed ones; any if empty.

    Raises:
        InputError: a wrong suffix, a directory, a link, a pipe, a device, or a folder that does
            not exist or cannot be written.
    """
    if path is None:
        return
    path = Path(path)
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(f"{path}: suffix is {path.suffix!r}, allowed: {', '.join(suffixes)}")
    with writing(path):
        if path.is_symlink():
            raise InputError(f"{path}: is a link, expected the name of a file")
        if path.is_dir():
            raise InputError(f"{path}: is a directory, expected the name of a file")
        if path.exists():
            check_file(path)
        if not path.parent.is_dir():
            raise InputError(f"{path}: there is no folder {path.parent}, expected an existing one")
        if not os.access(path.parent, os.W_OK):
            raise InputError(f"{path}: cannot be written (no permission in {path.parent})")


def check_outputs(arguments: argparse.Namespace, **suffixes: Sequence[str]) -> None:
    """Refuse output files before any work is done, each as ``check_writable``.

    Args:
        arguments: of a command.
        suffixes: the allowed suffixes of each output, by the option's name.

    Raises:
        InputError: also for an output that is the file of another argument.
    """
    for option, allowed in suffixes.items():
        path = getattr(arguments, option)
        check_writable(path, allowed)
        others = {key: value for key, value in vars(arguments).items() if key != option}
        for key, value in others.items() if path else ():
            for text in value if isinstance(value, list) else [value]:
                _check_other(option, path, key, text)


def _check_other(option: str, path: Path | str, key: str, value: object) -> None:
    """Refuse an output that is also another argument, or the file of an override."""
    if not isinstance(value, (str, Path)) or not str(value):
        return
    file = FILE_OVERRIDE.sub("", str(value))
    with writing(path):
        if os.path.realpath(file) == os.path.realpath(path):
            raise InputError(f"--{option} {path}: is also {key}, expected a different file")
