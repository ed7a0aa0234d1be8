"""Results of checks, and their table."""

import dataclasses
import textwrap
import time
from collections.abc import Callable

PASSED, FAILED, SKIPPED = "pass", "FAIL", "skipped"


@dataclasses.dataclass(frozen=True)
class Result:
    """One row of the table."""

    check: str
    verdict: str  # PASSED | FAILED | SKIPPED
    figure: str  # measured value, or why the check was skipped
    seconds: float = 0.0


class Skipped(Exception):
    """A check that cannot run on this machine; the message gives the reason."""


class Failed(Exception):
    """A check that failed; the message gives the reason."""


def run_check(name: str, check: Callable[[], str]) -> Result:
    """Run one check, which returns its figure or raises ``Skipped`` or ``Failed``."""
    start = time.monotonic()
    try:
        verdict, figure = PASSED, check()
    except Skipped as reason:
        verdict, figure = SKIPPED, str(reason)
    except Failed as reason:
        verdict, figure = FAILED, str(reason)
    except Exception as error:  # any other error is a failure
        verdict, figure = FAILED, f"{type(error).__name__}: {error}"
    return Result(name, verdict, " ".join(figure.split()), time.monotonic() - start)


def require(condition: bool, message: str) -> None:
    """Raise ``Failed`` with the message unless the condition holds."""
    if not condition:
        raise Failed(message)


def row_text(result: Result, width: int) -> str:
    """A row of the table, of lines of at most 79 characters where words allow it.

    ``width`` is that of the names of the checks.
    """
    start = f"{result.check:<{width}}  {result.verdict:<8}  {result.seconds:6.1f} s  "
    indent = " " * len(start)
    return textwrap.fill(
        start + result.figure, 79, subsequent_indent=indent, break_long_words=False
    )


def counts_text(results: list[Result]) -> str:
    """How many checks passed, failed and were skipped, and the time of all."""
    counts = {v: sum(r.verdict == v for r in results) for v in (PASSED, FAILED, SKIPPED)}
    return (
        f"{counts[PASSED]} passed, {counts[FAILED]} failed, {counts[SKIPPED]} skipped; "
        f"{sum(r.seconds for r in results):.0f} s"
    )
