"""The one exception for input that a person can mend, and how a script reports it."""

import contextlib
import functools
import os
import sys
from collections.abc import Callable

INTERRUPTED = 130  # exit status of what Ctrl-C ended


class InputError(ValueError):
    """Bad input: one line that names the file, key, row or value and what is allowed."""


def command_line(main: Callable[[], int | None]) -> Callable[[], None]:
    """Run a script's ``main``: exit status 2 and one line on stderr for an ``InputError``."""

    @functools.wraps(main)
    def wrapped() -> None:
        try:
            status = main()
            sys.stdout.flush()
        except InputError as error:
            print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
            status = 2
        except KeyboardInterrupt:
            print("interrupted", file=sys.stderr)
            status = INTERRUPTED
        except BrokenPipeError:
            # The reader (head, less) has gone: nothing more to say, not even at exit.
            with contextlib.suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            status = 1
        sys.exit(status or 0)

    return wrapped
