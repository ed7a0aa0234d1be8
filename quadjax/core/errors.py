"""The exception for bad input, and the reporting of errors by commands."""

import contextlib
import difflib
import functools
import json
import os
import re
import shlex
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ParamSpec

Arguments = ParamSpec("Arguments")
INTERRUPTED = 130  # exit status after Ctrl-C
BAD_INPUT = 2  # exit status after bad input and after system errors
MAX_LINE = 1000  # characters of a message that a command prints
PASSWORD = re.compile(r"(?!://USER:)(://[^\s:/@]*:)\S*(?=@)")  # of a URL, but not of its form
DEBUG = "QUADJAX_DEBUG"  # environment variable: if set, a command prints the traceback too
USER_ERRORS = (Exception, SystemExit)  # what a user's own code may raise, apart from Ctrl-C
USER_FILES: set[str] = set()  # of a user's modules that ``core.imports.load_object`` has imported


class InputError(ValueError):
    """Bad input: one line that names the file, key, row or value and what is allowed."""


class InputWarning(UserWarning):
    """Input that can be used, but perhaps not as it is meant: one line, as of an ``InputError``."""


def warn(text: str) -> None:
    """Warn in one line, which a command prints on stderr, once for each text."""
    warnings.warn(text, InputWarning, stacklevel=1)


@contextlib.contextmanager
def _printed_warnings() -> Iterator[None]:
    """Print each ``InputWarning`` in the block as one line on stderr."""
    with warnings.catch_warnings():
        show, printed = warnings.showwarning, set[str]()

        def print_line(
            message: Warning | str, category: type[Warning], *rest: Any, **named: Any
        ) -> None:
            text = str(message)
            if not issubclass(category, InputWarning):
                show(message, category, *rest, **named)
            elif text not in printed:
                printed.add(text)
                print(f"warning: {text}", file=sys.stderr)

        warnings.showwarning = print_line
        # JAX compiles where its cache cannot be read or written, which needs no message.
        cache = "Error (reading|writing) persistent compilation cache entry"
        warnings.filterwarnings("ignore", cache)
        warnings.simplefilter("always", InputWarning)
        yield


def short(value: object, limit: int = 60, text: Callable[[object], str] = repr) -> str:
    """A value as in a config, as text of a limited length, also a number of thousands of digits."""
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, int) and 1e15 < abs(value) < 1e300:
        return f"{value:g}"
    try:
        whole = text(list(value) if isinstance(value, tuple) else value)
    except ValueError:
        return "a number of thousands of digits"
    return whole if len(whole) <= limit else f"{whole[: limit - 3]}..."


def close_match(name: str, allowed: Sequence[str], count: int = 1) -> str:
    """``"; did you mean X?"`` for the allowed names closest to ``name``, or nothing.

    At most ``count`` are named. Initials are close, too: ``lr`` to ``learning_rate``.
    """
    near = difflib.get_close_matches(name, allowed, n=count)
    if not near and len(name) > 1:
        near = [x for x in allowed if "".join(word[:1] for word in x.split("_")) == name]
    return f"; did you mean {' or '.join(near[:count])}?" if near else ""


def quadjax_command(*words: object) -> str:
    """A command line of ``quadjax`` for a message, whose words are quoted for a shell."""
    return shlex.join(["quadjax", *map(str, words)])


@contextlib.contextmanager
def prefixed(text: str) -> Iterator[None]:
    """Put text before the message of an ``InputError`` (or ``ValueError``) in the block."""
    try:
        yield
    except ValueError as error:
        raise InputError(f"{text}: {error}") from error


@contextlib.contextmanager
def writing(path: Path | str) -> Iterator[None]:
    """Turn a system error in the block (disk full, no permission) into an ``InputError``."""
    try:
        yield
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


@contextlib.contextmanager
def reading(path: Path | str) -> Iterator[None]:
    """Turn an error of the system or of the encoding in the block into an ``InputError``."""
    try:
        yield
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{path}: no such file") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except InputError:
        raise
    except UnicodeDecodeError as error:
        lines = enumerate(Path(path).read_bytes().split(b"\n"), start=1)
        row = next((n for n, line in lines if line.decode(errors="ignore").encode() != line), 1)
        raise InputError(f"{path}: line {row} is not UTF-8 text") from error
    except ValueError as error:  # a path with a null byte
        raise InputError(f"{path}: cannot be read ({error})") from error


def as_command(main: Callable[Arguments, int | None]) -> Callable[Arguments, int]:
    """A decorator of the main function of a command, which then returns its exit status.

    Bad input and system errors (disk full, no permission, no memory) are printed as one line on
    stderr. Every other exception is a fault of the program, or of a user's own module, and is
    raised with its traceback.
    """

    @functools.wraps(main)
    def command(*args: Arguments.args, **kwargs: Arguments.kwargs) -> int:
        try:
            with _printed_warnings():
                status = main(*args, **kwargs)
            if sys.stdout is not None:  # None if the caller has closed it
                sys.stdout.flush()
            return status or 0
        except BrokenPipeError:
            # The reader (head, less) has exited. Nothing may be printed at exit either.
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            return INTERRUPTED
        except Exception as error:
            line = error_line(error)
            if line is None or os.environ.get(DEBUG):
                raise
            line = PASSWORD.sub(r"\1***", line)
            line = re.sub(r"\S{201,}", lambda word: f"{word[0][:50]}...{word[0][-50:]}", line)
            print(f"error: {short(line, MAX_LINE, str)}", file=sys.stderr)
            return BAD_INPUT

    return command


def user_error(error: BaseException) -> str:
    """An exception in a user's own code: its kind, the start of its message, and the line."""
    message = (str(error).splitlines() or [""])[0][:200]
    frames = traceback.extract_tb(error.__traceback__)
    lines = [f"{frame.filename}:{frame.lineno}" for frame in frames if frame.filename in USER_FILES]
    where = f" ({lines[-1]}; {DEBUG}=1 shows the traceback)" if lines else ""
    return f"{type(error).__name__}: {message}{where}"


def error_line(error: BaseException) -> str | None:
    """One line for bad input or a system error; None for faults of the program."""
    text = " ".join(str(error).split())
    if isinstance(error, InputError):
        return text
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{error.strerror}"
    if isinstance(error, MemoryError):
        return f"not enough memory ({text})" if text else "not enough memory"
    if type(error).__name__ in ("JaxRuntimeError", "XlaRuntimeError"):
        return f"not enough memory ({text[:160]})" if "RESOURCE_EXHAUSTED" in text else None
    return None
