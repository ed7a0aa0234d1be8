"""The exception for bad input, a check of integers, and the reporting of errors by commands."""

import contextlib
import os
import sys
from collections.abc import Callable
from numbers import Integral

INTERRUPTED = 130  # exit status after Ctrl-C
BAD_INPUT = 2  # exit status after bad input and after system errors
DEBUG = "QUADJAX_DEBUG"  # environment variable: if set, a command prints the traceback too


class InputError(ValueError):
    """Bad input: one line that names the file, key, row or value and what is allowed."""


def check_integer(name: str, value: object, least: int, most: int) -> None:
    """Raise an ``InputError`` that names the argument unless it is an integer in the range."""
    if (
        isinstance(value, bool)
        or not isinstance(value, Integral)
        or not least <= int(value) <= most
    ):
        raise InputError(f"{name} is {value!r}, allowed: an integer, {least} to {most}")


def run_command(main: Callable[[], int | None]) -> int:
    """Run the main function of a command and return its exit status.

    Bad input and system errors (disk full, no permission, no memory) are printed as one line on
    stderr. Every other exception is a fault of the program and is raised.
    """
    try:
        status = main()
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
        print(f"error: {line}", file=sys.stderr)
        return BAD_INPUT


def error_line(error: BaseException) -> str | None:
    """One line for bad input or a system error; None for a fault of the program."""
    text = " ".join(str(error).split())
    if isinstance(error, InputError):
        return text
    if isinstance(error, OSError) and error.strerror:
        where = f"{error.filename}: " if error.filename is not None else ""
        return f"{where}{error.strerror}"
    if isinstance(error, MemoryError):
        return f"not enough memory ({text})" if text else "not enough memory"
    if isinstance(error, OverflowError):
        return f"a number is too large ({text})"
    if isinstance(error, RecursionError):
        return f"the input is nested too deeply ({text})"
    if type(error).__name__ in ("JaxRuntimeError", "XlaRuntimeError"):
        return f"not enough memory ({text[:160]})" if "RESOURCE_EXHAUSTED" in text else None
    return None
