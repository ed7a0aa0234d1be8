"""Types of the arguments and options that several commands share.

A command is a function whose signature cyclopts reads. A type of this module says how the text of
an argument becomes a value, which values are allowed, and what the help prints. An option of
several values is a tuple of such a type.
"""

import dataclasses
import functools
import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import CoercionError, Group, Parameter, Token

from quadjax.cli.files import Output, OutputFolder, option_name, writable_folder
from quadjax.core.errors import InputError
from quadjax.core.resources import find_config, policy_file, preset_names
from quadjax.core.sections import FOLDER_NAME, MAX_DRONES, MAX_GATES, MAX_LAPS, MAX_RUNS, MAX_SEED

if TYPE_CHECKING:
    from quadjax.fitting.config import LogsConfig

PICTURES = (".png", ".svg", ".pdf")


def refuse(why: str, **options: object) -> None:
    """Refuse options that have no effect where they have a value.

    Args:
        why: text after "has no effect", such as "with --seeds".
        options: their values by name; None and False are those of options that are not given.
    """
    for name in _given(options):
        raise InputError(f"{option_name(name)} has no effect {why}")


def exclude(**options: object) -> None:
    """Refuse values of two or more of these options together."""
    if len(names := [option_name(name) for name in _given(options)]) > 1:
        raise InputError(f"{' and '.join(names)} exclude each other")


def _given(options: Mapping[str, object]) -> list[str]:
    return [name for name, value in options.items() if value is not None and value is not False]


def reads(convert: Callable[[str], Any], **named: Any) -> Parameter:
    """A parameter whose text a function converts; its ``ValueError`` says what is allowed."""

    def converter(_: object, tokens: Sequence[Token]) -> Any:
        try:
            return convert(tokens[0].value)
        except ValueError as error:
            raise CoercionError(msg=str(error), token=tokens[0]) from error

    return Parameter(converter=converter, **named)


def number(low: float, high: float, kind: type = float, **named: Any) -> Parameter:
    """The parameter of a number from ``low`` to ``high``."""

    def convert(text: str) -> float:
        try:
            value = kind(text)
        except ValueError:
            value = math.nan
        if not low <= value <= high:
            what, form = ("an integer", "") if kind is int else ("a number", "g")
            raise ValueError(f"{text!r}, allowed: {what}, {low:{form}} to {high:{form}}")
        return value

    return reads(convert, **named)


whole = functools.partial(number, kind=int)


def named_number(
    allowed: str, fits: Callable[[float], bool], names: Sequence[str] = (), **named: Any
) -> Parameter:
    """The parameter of a text ``NAME=NUMBER``; see ``by_name``.

    Args:
        allowed: description of the allowed texts, for messages.
        fits: whether a number is allowed.
        names: the allowed names; any if empty.
    """

    def convert(text: str) -> str:
        name, _, digits = text.partition("=")
        try:
            fitting = fits(float(digits))
        except ValueError:
            fitting = False
        if not fitting or not name or (names and name not in names):
            raise ValueError(f"{text!r}, allowed: {allowed}")
        return text

    return reads(convert, **named)


def by_name(option: str, texts: Sequence[str] | None) -> dict[str, float]:
    """The numbers of an option's ``NAME=NUMBER`` texts, by their names.

    Raises:
        InputError: a name occurs twice.
    """
    return {name: float(digits) for name, digits in assigned(option, texts).items()}


def assigned(option: str, texts: Sequence[str] | None) -> dict[str, str]:
    """The values of an option's ``NAME=VALUE`` texts, by their names.

    Raises:
        InputError: a name occurs twice.
    """
    values: dict[str, str] = {}
    for text in texts or ():
        name, _, value = text.partition("=")
        if name in values:
            raise InputError(f"{option} {text}: {name} has two values, allowed: one")
        values[name] = value
    return values


def check_shares(runs: int | None, drones: int | None) -> None:
    """Raise an ``InputError`` unless the runs are a multiple of the drones."""
    if runs and drones and runs % drones:
        raise InputError(f"--runs is {runs}, allowed: multiples of --drones ({drones})")


def path(allowed: str, convert: Callable[[str], Path] = Path, **named: Any) -> Parameter:
    """The parameter of a path, which is not empty; ``allowed`` is the text of what it may be."""

    def checked(text: str) -> Path:
        if not text:
            raise ValueError(f"'', allowed: {allowed}")
        return convert(text)

    return reads(checked, **named)


def _existing_file(text: str) -> Path:
    if not Path(text).is_file():
        fault = "is a folder" if Path(text).is_dir() else "no such file"
        raise ValueError(f"{text}: {fault}, allowed: a file")
    return Path(text)


def _run_name(text: str) -> str:
    if not re.fullmatch(FOLDER_NAME, text):
        allowed = "letters, digits, '_', '.' and '-', the last two not first"
        raise ValueError(f"{text!r}, allowed: {allowed}")
    return text


def config_parameter(folder: str, **named: Any) -> Parameter:
    """The parameter of a config in a folder of ``configs/``, whose help lists the names."""

    def convert(text: str) -> str:
        find_config(text, folder)
        return text

    names = ", ".join(preset_names(folder))
    return reads(convert, **{"help": f"A name ({names}) or a YAML file."} | named)


Flag = Annotated[bool, Parameter(show_default=False)]
Overwrite = Annotated[Flag, Parameter(help="Replace earlier results of the same name.")]
AllowCode = Annotated[
    Flag, Parameter(help="Import the reader of logs that the fit config names as module:OBJECT.")
]
AllowUnfinished = Annotated[
    Flag, Parameter(help="Accept a policy of which fewer than 90% of the simulated flights finish.")
]
AllowOtherRace = Annotated[
    Flag, Parameter(help="Accept a race that differs from the one in the policy file.")
]
ConfigName = Annotated[str, Parameter(name="CONFIG", help="A preset's name or a YAML file.")]
Overrides = Annotated[
    str, Parameter(name="KEY=VALUE", help="Changes of keys of the config, and +PART for parts.")
]
RunName = Annotated[str, reads(_run_name, metavar="NAME", help="Name of the folder.")]
PolicyFile = Annotated[
    Path,
    path("a policy file, the folder of a run, or a shipped policy", policy_file),
    Parameter(metavar="FILE.npz"),
]
PlantConfig = Annotated[str, config_parameter("plant", metavar="CONFIG")]
FitConfig = Annotated[str, config_parameter("fit", metavar="FIT.yaml")]
Race = Annotated[str | None, Parameter(metavar="CONFIG")]
Conditions = Annotated[
    str | None,
    config_parameter(
        "conditions",
        metavar="NAME",
        help=f"List of conditions: {', '.join(preset_names('conditions'))}, or a YAML file.",
    ),
]
Export = Annotated[Path, path("the folder of quadjax export, or a file")]
Folder = Annotated[Path, path("the name of a folder", writable_folder, metavar="DIR")]
RunsFolder = Annotated[Folder, OutputFolder(), Parameter(help="Write to DIR/NAME.")]
InputFile = Annotated[Path, path("a file", metavar="FILE")]
ExistingFile = Annotated[Path, path("a file", _existing_file, metavar="FILE")]
ExistingFiles = Annotated[ExistingFile, Parameter(required=True)]  # of ``*files``
Seed = Annotated[int, whole(0, MAX_SEED)]
Laps = Annotated[int, whole(1, MAX_LAPS)]
Gates = Annotated[int, whole(1, MAX_GATES)]
Runs = Annotated[int, whole(1, MAX_RUNS)]
Drones = Annotated[int, whole(1, MAX_DRONES)]
Count = Annotated[int, whole(1, 10**6)]
Positive = Annotated[float, number(1e-6, 50.0)]
LIST = Parameter(consume_multiple=True)  # values that follow one another; else the option repeats
Labels = Annotated[
    list[str] | None,
    LIST,
    Parameter(metavar="LABEL ...", help="Labels of some of the conditions (default: all)."),
]
Seeds = Annotated[tuple[Seed, ...], LIST, Parameter(metavar="N ...")]


@Parameter(name="*")
@dataclasses.dataclass(frozen=True)
class Logs:
    """How flight logs are read."""

    logs: Annotated[
        FitConfig | None,
        Parameter(
            help="Fit config that names the columns of the logs (default: by the header; "
            "of replay: plain columns)."
        ),
    ] = None
    allow_code: AllowCode = False

    def columns(self) -> "LogsConfig":
        """The section ``logs`` of the fit config; plain columns without one."""
        from quadjax.fitting.config import LogsConfig, load_fit_config

        if self.logs is None:
            return LogsConfig()
        return load_fit_config(self.logs, allow_code=self.allow_code).logs


PLAIN_LOGS = Logs()
FILES = Group("Output files", sort_key=3)


JsonFile = Annotated[
    Path | None,
    Output((".json",)),
    Parameter(metavar="FILE.json", group=FILES, help="Write the numbers."),
]
NpzFile = Annotated[Path | None, Output((".npz",)), Parameter(metavar="FILE.npz", group=FILES)]
Picture = Annotated[Path | None, Output(PICTURES), Parameter(metavar="FILE.png", group=FILES)]
